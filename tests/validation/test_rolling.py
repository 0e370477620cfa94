"""Tests the checks of slip, turning radius and wheel speed of wheeled bases."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from helpers.drives import drive_through, make_hall, make_trajectory, move_start
from helpers.judging import get_only_violation

import vkc_pin as vkc
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.trajectory import Trajectory


def test_slip_of_a_motion_without_curve_is_reported() -> None:
    scene = make_hall(base="differential")
    ahead = drive_through(
        scene, scene.start, move_start(scene.start, x=2.0), move_start(scene.start, x=2.0, yaw=1.0)
    )
    assert validate(scene, [vkc.GoTo(2.0, 0.0, 1.0)], ahead).ok
    heading = np.linspace(0.0, 1.5, 41)
    curve = np.tile(
        scene.start, (41, 1)
    )  # circle of 1 m to the left; chords have the mean heading of their step
    curve[:, 0], curve[:, 1], curve[:, 2] = np.sin(heading), 1.0 - np.cos(heading), heading
    assert "slip" not in {
        v.constraint
        for v in validate(scene, [vkc.GoTo(1.0, 1.0)], make_trajectory(scene, curve)).violations
    }
    sideways = drive_through(scene, scene.start, move_start(scene.start, x=2.0, y=0.1))
    found = get_only_violation(validate(scene, [vkc.GoTo(2.0, 0.1, 0.0)], sideways))
    assert (found.constraint, found.subject, found.unit) == ("slip", "base", "m")
    steps = np.diff(sideways.positions[:, 1])
    assert found.amount == pytest.approx(steps.max())
    assert found.waypoint == steps.argmax()
    assert found.time == pytest.approx(sideways.times[found.waypoint])
    for step, ok in ((0.9e-4, True), (1.5e-4, False)):  # the tolerance is 0.1 mm per step
        aside = drive_through(
            scene, scene.start, move_start(scene.start, x=2.0, y=0.1 * step / found.amount)
        )
        assert (
            "slip"
            not in {v.constraint for v in validate(scene, [vkc.GoTo(2.0, 0.0)], aside).violations}
        ) == ok
    assert validate(make_hall(), [vkc.GoTo(2.0, 0.1, 0.0)], sideways).ok


@pytest.mark.parametrize(("radius", "ok"), [(0.99, True), (1.01, False)])
def test_turning_radius_of_a_motion_without_curve_is_checked(radius: float, ok: bool) -> None:
    scene = make_hall(base="ackermann", turning_radius=radius)
    heading = np.concatenate([np.linspace(0.0, 1.5, 41), np.linspace(1.5, 0.3, 33)[1:]])
    rows = np.tile(scene.start, (len(heading), 1))
    rows[:, 0], rows[:, 1], rows[:, 2] = np.sin(heading), 1.0 - np.cos(heading), heading
    motion = make_trajectory(scene, rows)
    found = {v.constraint: v for v in validate(scene, [vkc.GoTo(*rows[-1, :3])], motion).violations}
    assert "slip" not in found
    assert ("turning" not in found) == ok
    if not ok:
        chord = 2.0 * np.sin(np.diff(heading)[0] / 2)
        assert found["turning"].amount == pytest.approx(
            radius * np.diff(heading)[0] - chord, rel=1e-6
        )
        assert (found["turning"].subject, found["turning"].unit) == ("base", "m")


def test_steered_base_must_not_turn_in_place() -> None:
    scene = make_hall(base="ackermann", turning_radius=0.8)
    motion = drive_through(
        scene, scene.start, move_start(scene.start, x=2.0), move_start(scene.start, x=2.0, yaw=1.0)
    )
    found = get_only_violation(validate(scene, [vkc.GoTo(2.0, 0.0, 1.0)], motion))
    assert (found.constraint, found.subject, found.unit) == ("turning", "base", "m")
    assert found.amount == pytest.approx(0.8 * np.diff(motion.positions[:, 2]).max())
    assert "radius of 0.8 m" in found.detail


@pytest.mark.parametrize("base", ["differential", "ackermann"])
def test_wheel_speed_of_a_motion_without_curve_is_checked(base: str) -> None:
    """On a circle of 1 m the outer wheels roll 1 + track / 2 times as fast as the base."""
    scene = make_hall(base=base, **({"turning_radius": 0.8} if base == "ackermann" else {}))
    wheels = scene.robot.wheels
    assert wheels is not None
    assert wheels.rim_speed == pytest.approx(
        1.0, rel=1e-3
    )  # Clearpath's speed limit of the Husky [m/s]
    heading = np.concatenate(
        [
            np.zeros(1),
            np.cumsum(np.interp(np.arange(60), [0, 10, 49, 59], [0.0, 0.9, 0.9, 0.0]) * 0.05),
        ]
    )
    rows = np.tile(scene.start, (len(heading), 1))
    rows[:, 0], rows[:, 1], rows[:, 2] = np.sin(heading), 1.0 - np.cos(heading), heading
    goal = [vkc.GoTo(*rows[-1, :3])]
    found = get_only_violation(validate(scene, goal, make_trajectory(scene, rows, dt=0.05)))
    assert (found.constraint, found.subject, found.unit) == ("wheels", "base", "m/s")
    turn = np.diff(heading).max()
    fastest = (2.0 * np.sin(turn / 2) + turn * wheels.track / 2) / 0.05
    assert found.amount == pytest.approx(fastest - wheels.rim_speed)
    for excess, ok in (
        (0.5, True),
        (2.0, False),
    ):  # multiples of the tolerance, a thousandth of the wheels' speed limit
        dt = 0.05 * fastest / (wheels.rim_speed * (1.0 + excess * 1e-3))
        assert validate(scene, goal, make_trajectory(scene, rows, dt=dt)).ok == ok
    assert validate(scene, goal, make_trajectory(scene, rows, dt=0.05 * fastest)).ok
    omni = make_hall()
    assert validate(omni, goal, make_trajectory(omni, rows, dt=0.05)).ok
    straight = drive_through(scene, scene.start, move_start(scene.start, x=1.0), dt=1.5 / 40 / 0.99)
    assert validate(scene, [vkc.GoTo(1.0, 0.0)], straight).ok


def make_circle(
    scene: Scene, *, radius: float = 1.0, peak: float = 0.4, aside: float = 0.0
) -> tuple[list[Any], Trajectory]:
    """Return the goal and the motion of a quarter circle to the left, with a lateral velocity.

    Args:
        scene: The scene.
        radius: Radius of the circle [m].
        peak: Largest angular velocity [rad/s].
        aside: Largest velocity along −x [m/s], which is lateral at the end.
    """
    duration = 1.5 * (np.pi / 2) / peak
    times = np.linspace(0.0, duration, 81)
    s = times / duration
    yaw, turning = np.pi / 2 * (3.0 - 2.0 * s) * s**2, np.pi / 2 * 6.0 * (s - s**2) / duration
    rows, rates = np.tile(scene.start, (81, 1)), np.zeros((81, len(scene.start)))
    slide = aside * (1.0 - np.cos(2.0 * np.pi * s)) / 2
    rows[:, 0], rows[:, 1], rows[:, 2] = radius * np.sin(yaw), radius * (1.0 - np.cos(yaw)), yaw
    rates[:, 0], rates[:, 1] = radius * turning * np.cos(yaw), radius * turning * np.sin(yaw)
    rates[:, 2] = turning
    rows[1:, 0] -= np.cumsum((slide[1:] + slide[:-1]) / 2 * np.diff(times))
    rates[:, 0] -= slide
    motion = dataclasses.replace(
        make_trajectory(scene, rows), times=times, curve=Curve(times, rows, rates)
    )
    return [vkc.GoTo(*rows[-1, :3])], motion


def test_slip_along_a_curve_is_reported() -> None:
    """At heading θ, the velocity along −x is lateral by a factor of sin θ."""
    scene = make_hall(base="differential")
    assert validate(scene, *make_circle(scene)).ok
    goal, motion = make_circle(scene, aside=0.01)
    found = get_only_violation(validate(scene, goal, motion))
    assert (found.constraint, found.subject, found.unit) == ("slip", "base", "m/s")
    moments = np.linspace(0.0, motion.times[-1], 5000)
    (vx, vy), yaw = motion.velocity(moments)[:, :2].T, motion(moments)[:, 2]
    slip = np.abs(np.cos(yaw) * vy - np.sin(yaw) * vx)
    assert found.amount == pytest.approx(slip.max(), rel=1e-3)
    assert found.time == pytest.approx(moments[slip.argmax()], abs=0.05)
    assert motion.times[found.waypoint] <= found.time <= motion.times[found.waypoint + 1]
    assert "mm/s" in found.detail
    assert validate(make_hall(), goal, motion).ok
    for allowed, ok in ((0.95e-3, True), (1.1e-3, False)):
        report = validate(scene, *make_circle(scene, aside=0.01 * allowed / found.amount))
        assert report.ok == ok


@pytest.mark.parametrize(("radius", "ok"), [(0.997, True), (1.01, False)])
def test_turning_radius_along_a_curve_is_checked(radius: float, ok: bool) -> None:
    scene = make_hall(base="ackermann", turning_radius=radius)
    report = validate(scene, *make_circle(scene))
    assert report.ok == ok
    if not ok:
        found = get_only_violation(report)
        assert (found.constraint, found.unit) == ("turning", "m/s")
        assert found.amount == pytest.approx((radius - 1.0) * 0.4, rel=1e-2)


def test_wheel_speed_along_a_curve_is_checked() -> None:
    scene = make_hall(base="differential")
    assert scene.robot.wheels is not None
    peak = scene.robot.wheels.rim_speed / (1.0 + scene.robot.wheels.track / 2)
    assert validate(scene, *make_circle(scene, peak=0.999 * peak)).ok
    found = get_only_violation(validate(scene, *make_circle(scene, peak=1.02 * peak)))
    assert (found.constraint, found.subject, found.unit) == ("wheels", "base", "m/s")
    assert found.amount == pytest.approx(0.02 * scene.robot.wheels.rim_speed, rel=0.02)
