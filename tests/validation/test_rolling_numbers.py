"""What a base on wheels does, in numbers that are known by hand: amounts, moments, waypoints, and what is still all right."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vkc_pin.validation.report import Violation
from vkc_pin.validation.rolling import (
    SLIP_TOLERANCE,
    STEP_TOLERANCE,
    WHEEL_TOLERANCE,
    check_rolling,
)
from vkc_pin.world.trajectory.curve import Curve

WHEELS = SimpleNamespace(rim_speed=2.0, track=0.5)
TIMES = np.array([0.0, 1.0, 3.0, 4.0])


def found(
    rows: Any,
    *,
    base: str = "differential",
    wheels: Any = None,
    radius: float = 0.0,
    rates: Any = None,
) -> list[Violation]:
    """Return what is said of a base that is at (x, y, yaw) at `TIMES`; with `rates` it moves along cubics."""
    positions = np.asarray(rows, float)
    curve = None if rates is None else Curve(TIMES, positions, np.asarray(rates, float))
    robot = SimpleNamespace(base=base, wheels=wheels, turning_radius=radius)
    motion = SimpleNamespace(times=TIMES, positions=positions, curve=curve)
    samples: Any = SimpleNamespace(scene=SimpleNamespace(robot=robot), trajectory=motion)
    return list(check_rolling(samples))


def test_tolerances_are_those_of_the_pages() -> None:
    assert (STEP_TOLERANCE, SLIP_TOLERANCE, WHEEL_TOLERANCE) == (1e-4, 1e-3, 1e-3)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("step", [0, 1, 2])
def test_a_step_aside_is_named_where_it_begins(step: int, sign: float) -> None:
    rows = np.zeros((4, 3))
    rows[:, 0] = [0.0, 1.0, 2.0, 3.0]
    rows[step + 1 :, 1] = sign * 0.01
    (one,) = found(rows)
    assert (one.constraint, one.subject, one.waypoint, one.time, one.unit) == (
        "slip",
        "base",
        step,
        TIMES[step],
        "m",
    )
    assert one.amount == pytest.approx(0.01)
    assert one.detail == "the base slips sideways by 10.00 mm in a step"
    for base in ("omni", "fixed"):
        assert found(rows, base=base) == []


@pytest.mark.parametrize(("aside", "told"), [(0.95e-4, False), (1.05e-4, True)])
def test_a_tenth_of_a_millimetre_is_all_right(aside: float, told: bool) -> None:
    rows = np.zeros((4, 3))
    rows[2:, 1] = aside
    assert bool(found(rows)) == told


def test_a_step_is_seen_from_where_it_heads_half_way() -> None:
    """Along an arc of 0.8 rad around (0, 1): the chord points at 0.4 rad."""
    turn = np.array([0.0, 0.8, 0.8, 0.8])
    rows = np.column_stack([np.sin(turn), 1.0 - np.cos(turn), turn])
    assert found(rows) == []
    rows[1:, 2] = 0.7
    (one,) = found(rows)
    assert one.amount == pytest.approx(2.0 * np.sin(0.4) * np.sin(0.05))


def test_a_turn_takes_a_way() -> None:
    """On the spot an Ackermann base cannot turn; on its least circle it can."""
    rows = np.zeros((4, 3))
    rows[2:, 2] = 0.5
    (one,) = found(rows, base="ackermann", radius=2.0)
    assert (one.constraint, one.waypoint, one.time, one.unit) == ("turning", 1, 1.0, "m")
    assert one.amount == pytest.approx(1.0)
    assert (
        one.detail
        == "the base drives 1000.00 mm in a step less than its turn requires at a radius of 2 m"
    )
    assert found(rows) == []
    rows[2:, 0], rows[2:, 1] = 2.0 * np.sin(0.5), 2.0 * (1.0 - np.cos(0.5))
    short = 2.0 * 0.5 - 2.0 * 2.0 * np.sin(0.25)  # the chord is shorter than the arc
    (one,) = found(rows, base="ackermann", radius=2.0)
    assert one.amount == pytest.approx(short)
    assert (
        found(rows * [-1.0, 1.0, -1.0], base="ackermann", radius=1.9) == []
    )  # backwards, and turning to the right


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_wheel_is_too_fast(sign: float) -> None:
    """In the last step, of 1 s: 1.9 m along and a turn of 0.8 rad are 2.1 m/s of the outer wheel."""
    rows = np.zeros((4, 3))
    rows[2, 0] = sign * 3.0  # in 2 s
    rows[3] = rows[2] + sign * np.array([1.9 * np.cos(0.4), 1.9 * np.sin(0.4) * sign, 0.8])
    rows[3, 1] = 1.9 * np.sin(0.4)
    rows[3, 0] = rows[2, 0] + sign * 1.9 * np.cos(0.4)
    rows[3, 2] = sign * 0.8
    (one,) = found(rows, wheels=WHEELS)
    assert (one.constraint, one.waypoint, one.time, one.unit) == ("wheels", 2, 3.0, "m/s")
    assert one.amount == pytest.approx(0.1)
    assert one.detail == "the base has a wheel that is 0.100 m/s over 2.000 m/s"
    assert found(rows) == []


@pytest.mark.parametrize(("share", "told"), [(1.0009, False), (1.0011, True)])
def test_a_thousandth_of_the_wheels_speed_is_all_right(share: float, told: bool) -> None:
    rows = np.zeros((4, 3))
    rows[2:, 0] = 2.0 * 2.0 * share
    assert bool(found(rows, wheels=WHEELS)) == told


def straight(speed_aside: float) -> tuple[np.ndarray, np.ndarray]:
    """Return places and velocities along x at 1 m/s, and aside at some speed at the last knot alone."""
    rows, rates = np.zeros((4, 3)), np.zeros((4, 3))
    rows[:, 0], rates[:, 0] = TIMES, 1.0
    rates[3, 1] = speed_aside
    return rows, rates


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_along_a_curve_velocities_count(sign: float) -> None:
    """At its very end, too: that is the last waypoint."""
    rows, rates = straight(sign * 0.3)
    (one,) = found(rows, rates=rates)
    assert (one.constraint, one.waypoint, one.time, one.unit) == ("slip", 3, 4.0, "m/s")
    assert one.amount == pytest.approx(0.3)
    assert one.detail == "the base slips sideways by 300.00 mm/s"
    assert found(*straight(0.95e-3)[:1], rates=straight(0.95e-3)[1]) == []
    assert len(found(straight(1.05e-3)[0], rates=straight(1.05e-3)[1])) == 1


def test_along_a_curve_heading_counts_at_each_moment() -> None:
    """It drives along x and heads 0.2 rad aside at one knot."""
    rows, rates = straight(0.0)
    rows[1, 2] = 0.2
    (one,) = found(rows, rates=rates)
    assert (one.constraint, one.waypoint, one.time) == ("slip", 1, 1.0)
    assert one.amount == pytest.approx(np.sin(0.2))


def test_along_a_curve_a_turn_takes_a_speed_and_wheels_have_a_most() -> None:
    """At the second knot 1 m/s and 0.8 rad/s: a radius of 2 m would take 1.6 m/s, and the outer wheel goes at 1.2 m/s."""
    rows, rates = straight(0.0)
    rates[1, 2] = 0.8
    told = {one.constraint: one for one in found(rows, base="ackermann", radius=2.0, rates=rates)}
    assert (told["turning"].waypoint, told["turning"].time, told["turning"].unit) == (1, 1.0, "m/s")
    assert told["turning"].amount == pytest.approx(0.6)
    slow = SimpleNamespace(rim_speed=1.1, track=0.5)
    told = {one.constraint: one for one in found(rows, wheels=slow, rates=rates)}
    assert (told["wheels"].waypoint, told["wheels"].time, told["wheels"].unit) == (1, 1.0, "m/s")
    assert told["wheels"].amount == pytest.approx(0.1)
