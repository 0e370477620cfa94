"""Bases on wheels: along, not aside, no tighter than they steer and no faster than their wheels, in steps and along curves."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.drives import hall, moved, of_rows, through
from helpers.judging import only

import vkc_pin as vkc
from vkc_pin.validation.rolling import SLIP_TOLERANCE
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.trajectory import Trajectory


def test_a_differential_base_does_not_slip() -> None:
    scene = hall(base="differential")
    ahead = through(
        scene, scene.start, moved(scene.start, x=2.0), moved(scene.start, x=2.0, yaw=1.0)
    )
    assert validate(scene, [vkc.GoTo(2.0, 0.0, 1.0)], ahead).ok
    heading = np.linspace(0.0, 1.5, 41)
    curve = np.tile(
        scene.start, (41, 1)
    )  # a circle of 1 m to the left, the chords at the headings in the middle of each step
    curve[:, 0], curve[:, 1], curve[:, 2] = np.sin(heading), 1.0 - np.cos(heading), heading
    assert "slip" not in {
        v.constraint
        for v in validate(scene, [vkc.GoTo(1.0, 1.0)], of_rows(scene, curve)).violations
    }
    sideways = through(scene, scene.start, moved(scene.start, x=2.0, y=0.1))
    found = only(validate(scene, [vkc.GoTo(2.0, 0.1, 0.0)], sideways))
    assert (found.constraint, found.subject, found.unit) == ("slip", "base", "m")
    assert found.amount == pytest.approx(np.diff(sideways.positions[:, 1]).max())
    for step, right in ((0.9e-4, True), (1.5e-4, False)):  # 0.1 mm aside in a step is all right
        aside = through(scene, scene.start, moved(scene.start, x=2.0, y=0.1 * step / found.amount))
        assert (
            "slip"
            not in {v.constraint for v in validate(scene, [vkc.GoTo(2.0, 0.0)], aside).violations}
        ) == right
    assert validate(hall(), [vkc.GoTo(2.0, 0.1, 0.0)], sideways).ok


@pytest.mark.parametrize(("radius", "ok"), [(0.99, True), (1.01, False)])
def test_a_steered_base_turns_no_tighter_than_it_can(radius: float, ok: bool) -> None:
    """Along a circle of 1 m, ahead and back again."""
    scene = hall(base="ackermann", turning_radius=radius)
    heading = np.concatenate([np.linspace(0.0, 1.5, 41), np.linspace(1.5, 0.3, 33)[1:]])
    rows = np.tile(scene.start, (len(heading), 1))
    rows[:, 0], rows[:, 1], rows[:, 2] = np.sin(heading), 1.0 - np.cos(heading), heading
    motion = of_rows(scene, rows)
    found = {v.constraint: v for v in validate(scene, [vkc.GoTo(*rows[-1, :3])], motion).violations}
    assert "slip" not in found
    assert ("turning" not in found) == ok
    if not ok:
        chord = 2.0 * np.sin(np.diff(heading)[0] / 2)
        assert found["turning"].amount == pytest.approx(
            radius * np.diff(heading)[0] - chord, rel=1e-6
        )
        assert (found["turning"].subject, found["turning"].unit) == ("base", "m")


def test_a_steered_base_does_not_turn_in_place() -> None:
    scene = hall(base="ackermann", turning_radius=0.8)
    motion = through(
        scene, scene.start, moved(scene.start, x=2.0), moved(scene.start, x=2.0, yaw=1.0)
    )
    found = only(validate(scene, [vkc.GoTo(2.0, 0.0, 1.0)], motion))
    assert (found.constraint, found.subject, found.unit) == ("turning", "base", "m")
    assert found.amount == pytest.approx(0.8 * np.diff(motion.positions[:, 2]).max())
    assert "radius of 0.8 m" in found.detail


@pytest.mark.parametrize("base", ["differential", "ackermann"])
def test_wheels_turn_no_faster_than_they_can(base: str) -> None:
    """On a circle of 1 m the outer wheels go 1 + track / 2 times as fast as the middle; straight ahead as fast."""
    scene = hall(base=base, **({"turning_radius": 0.8} if base == "ackermann" else {}))
    wheels = scene.robot.wheels
    assert wheels is not None
    assert wheels.rim_speed == pytest.approx(
        1.0, rel=1e-3
    )  # Clearpath's limit on the speed of a Husky [m/s]
    heading = np.concatenate(
        [
            np.zeros(1),
            np.cumsum(np.interp(np.arange(60), [0, 10, 49, 59], [0.0, 0.9, 0.9, 0.0]) * 0.05),
        ]
    )
    rows = np.tile(scene.start, (len(heading), 1))
    rows[:, 0], rows[:, 1], rows[:, 2] = np.sin(heading), 1.0 - np.cos(heading), heading
    goal = [vkc.GoTo(*rows[-1, :3])]
    found = only(validate(scene, goal, of_rows(scene, rows, dt=0.05)))
    assert (found.constraint, found.subject, found.unit) == ("wheels", "base", "m/s")
    turn = np.diff(heading).max()
    fastest = (2.0 * np.sin(turn / 2) + turn * wheels.track / 2) / 0.05
    assert found.amount == pytest.approx(fastest - wheels.rim_speed)
    for excess, right in (
        (0.5, True),
        (2.0, False),
    ):  # times what is all right, a thousandth of what the wheels can
        dt = 0.05 * fastest / (wheels.rim_speed * (1.0 + excess * 1e-3))
        assert validate(scene, goal, of_rows(scene, rows, dt=dt)).ok == right
    assert validate(scene, goal, of_rows(scene, rows, dt=0.05 * fastest)).ok
    everywhere = hall()
    assert validate(everywhere, goal, of_rows(everywhere, rows, dt=0.05)).ok
    straight = through(scene, scene.start, moved(scene.start, x=1.0), dt=1.5 / 40 / 0.99)
    assert validate(scene, [vkc.GoTo(1.0, 0.0)], straight).ok


def circling(
    scene: Scene, *, radius: float = 1.0, peak: float = 0.4, aside: float = 0.0
) -> tuple[Trajectory, list[Any]]:
    """Return a motion on a circle to the left for a quarter, and its goal: at most `peak` rad/s, and `aside` m/s to the left.

    The velocities at its knots are exact, and knots close to each other.
    """
    duration = 1.5 * (np.pi / 2) / peak
    times = np.linspace(0.0, duration, 81)
    s = times / duration
    yaw, turning = np.pi / 2 * (3.0 - 2.0 * s) * s**2, np.pi / 2 * 6.0 * (s - s**2) / duration
    rows, rates = np.tile(scene.start, (81, 1)), np.zeros((81, len(scene.start)))
    slide = aside * (1.0 - np.cos(2.0 * np.pi * s)) / 2
    rows[:, 0], rows[:, 1], rows[:, 2] = radius * np.sin(yaw), radius * (1.0 - np.cos(yaw)), yaw
    rates[:, 0], rates[:, 1], rates[:, 2] = (
        radius * turning * np.cos(yaw),
        radius * turning * np.sin(yaw),
        turning,
    )
    way = np.concatenate([[0.0], np.cumsum((slide[1:] + slide[:-1]) / 2 * np.diff(times))])
    rows[:, 0] -= way  # along x, which is aside at the end, and along at the begin
    rates[:, 0] -= slide
    motion = of_rows(scene, rows)
    curve = Curve(times, rows, rates)
    motion = Trajectory(
        motion.names, times, motion.positions, motion.phases, motion.robot_size, curve
    )
    return motion, [vkc.GoTo(*rows[-1, :3])]


def test_a_curve_may_slip_a_little_at_any_moment() -> None:
    """Where it heads by θ, what moves it along −x moves it aside by sin θ times as much."""
    scene = hall(base="differential")
    assert validate(scene, *circled(scene)).ok
    motion, goal = circling(scene, aside=0.01)
    found = only(validate(scene, goal, motion))
    assert (found.constraint, found.subject, found.unit) == ("slip", "base", "m/s")
    moments = np.linspace(0.0, motion.times[-1], 5000)
    (vx, vy), yaw = motion.velocity(moments)[:, :2].T, motion(moments)[:, 2]
    assert found.amount == pytest.approx(
        np.abs(np.cos(yaw) * vy - np.sin(yaw) * vx).max(), rel=1e-3
    )
    assert "mm/s" in found.detail
    assert validate(scene, *circled(scene, aside=0.9 * SLIP_TOLERANCE)).ok
    assert validate(hall(), goal, motion).ok
    assert SLIP_TOLERANCE == 1e-3  # [m/s], as the pages say
    for slip, right in ((0.95e-3, True), (1.1e-3, False)):
        assert validate(scene, *circled(scene, aside=0.01 * slip / found.amount)).ok == right


def circled(scene: Scene, **about: float) -> tuple[list[Any], Trajectory]:
    motion, goal = circling(scene, **about)
    return goal, motion


@pytest.mark.parametrize(("radius", "ok"), [(0.997, True), (1.01, False)])
def test_a_curve_is_no_tighter_than_a_base_steers(radius: float, ok: bool) -> None:
    scene = hall(base="ackermann", turning_radius=radius)
    report = validate(scene, *circled(scene))
    assert report.ok == ok
    if not ok:
        found = only(report)
        assert (found.constraint, found.unit) == ("turning", "m/s")
        assert found.amount == pytest.approx((radius - 1.0) * 0.4, rel=1e-2)


def test_wheels_along_a_curve() -> None:
    """The outer ones go 1 + track / 2 times as fast on a circle of 1 m."""
    scene = hall(base="differential")
    assert scene.robot.wheels is not None
    peak = scene.robot.wheels.rim_speed / (1.0 + scene.robot.wheels.track / 2)
    assert validate(scene, *circled(scene, peak=0.999 * peak)).ok
    found = only(validate(scene, *circled(scene, peak=1.02 * peak)))
    assert (found.constraint, found.subject, found.unit) == ("wheels", "base", "m/s")
    assert found.amount == pytest.approx(0.02 * scene.robot.wheels.rim_speed, rel=0.02)


def test_between_waypoints_a_spline_through_them_slips() -> None:
    """Every step is an arc, and splines through x, y and yaw pass all of its ends; but they are no motion of wheels."""
    from scipy.interpolate import CubicSpline

    scene = hall(base="differential")
    heading = np.array([0.0, 0.0, 0.0, 0.4, 0.8, 0.8, 0.8])
    turn = np.diff(heading)
    ways = 0.3 * np.sinc(turn / (2 * np.pi)) * np.exp(1j * (heading[:-1] + turn / 2))
    places = np.concatenate([[0.0], np.cumsum(ways)])
    rows = np.tile(scene.start, (7, 1))
    rows[:, 0], rows[:, 1], rows[:, 2] = places.real, places.imag, heading
    times = np.arange(7.0)
    goal = [vkc.GoTo(*rows[-1, :3])]
    motion = of_rows(scene, rows, dt=1.0)
    assert validate(scene, goal, motion).ok
    curve = Curve(times, rows, CubicSpline(times, rows, bc_type="clamped")(times, 1))
    smooth = Trajectory(
        motion.names, times, motion.positions, motion.phases, motion.robot_size, curve
    )
    assert only(validate(scene, goal, smooth)).constraint == "slip"
