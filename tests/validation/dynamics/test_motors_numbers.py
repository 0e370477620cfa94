"""Rates, torques and what bounds a motion, with motions that are numbers alone."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vkc_pin.options import Options
from vkc_pin.validation.dynamics import torques as torques_module
from vkc_pin.validation.dynamics.bounds import find_limiting_constraints
from vkc_pin.validation.dynamics.rates import (
    ACCEPTED_RATE_TOLERANCE,
    JUMP_TOLERANCE,
    REST_TOLERANCE,
    check_rates,
)
from vkc_pin.validation.dynamics.torques import TORQUE_TOLERANCE, MotorLoads

TIMES = np.array([0.0, 1.0, 3.0, 4.0])
KNOTS = np.array([0.0, 0.5, 1.0, 3.0, 4.0])


def test_tolerances_are_those_of_the_pages() -> None:
    assert (ACCEPTED_RATE_TOLERANCE, REST_TOLERANCE, JUMP_TOLERANCE, TORQUE_TOLERANCE) == (
        1e-3,
        1e-6,
        1e-3,
        5e-3,
    )


# --- rates
# ------------------------------------------------------------------------------------------------------------


def column(count: int, **values: float) -> np.ndarray:
    """Return zeros but for "at_<row>"."""
    found = np.zeros((count, 1))
    for name, value in values.items():
        found[int(name.removeprefix("at_")), 0] = value
    return found


def told(
    *,
    velocity: np.ndarray | None = None,
    acceleration: np.ndarray | None = None,
    smooth: bool = True,
    rests: tuple[float, float] = (0.0, 0.0),
    jerk: np.ndarray | None = None,
    jumps: np.ndarray | None = None,
    jerk_time: float = 0.0,
    limits: tuple[float, float] = (2.0, 4.0),
) -> list[tuple[Any, ...]]:
    """Return what is said of a coordinate of these rates: kind, waypoint, time, amount, unit and detail."""
    count = len(KNOTS) - 1 if smooth else len(TIMES) - 1
    velocity = column(count) if velocity is None else velocity
    acceleration = column(count if smooth else count + 1) if acceleration is None else acceleration
    rates = column(len(KNOTS), at_0=rests[0], at_4=rests[1])
    curve = SimpleNamespace(
        times=KNOTS,
        rates=rates,
        compute_max_rates=lambda: (np.abs(velocity), np.abs(acceleration)),
        compute_jerks=lambda: (
            column(4) if jerk is None else jerk,
            column(5) if jumps is None else jumps,
        ),
    )
    motion = SimpleNamespace(
        times=TIMES,
        names=("joint",),
        curve=curve if smooth else None,
        velocities=lambda: velocity,
        accelerations=lambda: acceleration,
    )
    samples: Any = SimpleNamespace(
        trajectory=motion, get_limits=lambda name: (0.0, 0.0, *limits), get_unit=lambda name: "rad"
    )
    rows = list(check_rates(samples, Options(jerk_time=jerk_time)))
    assert {one.subject for one in rows} <= {"joint"}
    return [
        (one.constraint, one.waypoint, one.time, pytest.approx(one.amount), one.unit, one.detail)
        for one in rows
    ]


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_without_a_curve_steps_have_velocities_and_waypoints_accelerations(sign: float) -> None:
    assert told(smooth=False, velocity=column(3, at_1=sign * 2.5)) == [
        ("velocity", 1, 1.0, 0.5, "rad/s", "2.500 rad/s is more than 2.000 rad/s")
    ]
    assert told(smooth=False, acceleration=column(4, at_3=sign * 5.0)) == [
        ("acceleration", 3, 4.0, 1.0, "rad/s²", "5.000 rad/s² is more than 4.000 rad/s²")
    ]
    assert (
        told(
            smooth=False,
            velocity=column(3, at_0=sign * 2.0),
            jerk=column(4, at_0=99.0),
            jerk_time=1.0,
        )
        == []
    )


def test_along_a_curve_each_cubic_has_its_largest() -> None:
    """The third begins at the second waypoint, the second half-way before it."""
    for piece, at in ((0, 0), (1, 0), (2, 1), (3, 2)):
        assert told(velocity=column(4, **{f"at_{piece}": 2.5})) == [
            ("velocity", at, TIMES[at], 0.5, "rad/s", "2.500 rad/s is more than 2.000 rad/s")
        ]
        assert [row[:2] for row in told(acceleration=column(4, **{f"at_{piece}": 5.0}))] == [
            ("acceleration", at)
        ]


@pytest.mark.parametrize(("share", "wrong"), [(1.0009, False), (1.0011, True)])
def test_a_thousandth_more_is_all_right(share: float, wrong: bool) -> None:
    assert bool(told(velocity=column(4, at_0=2.0 * share))) == wrong
    assert bool(told(acceleration=column(4, at_0=4.0 * share))) == wrong
    assert bool(told(jerk=column(4, at_0=8.0 * share), jerk_time=0.5)) == wrong


@pytest.mark.parametrize("end", [0, 1])
@pytest.mark.parametrize(
    ("speed", "wrong"), [(0.9e-6, False), (-0.9e-6, False), (1.1e-6, True), (-1.1e-6, True)]
)
def test_it_rests_at_both_ends(end: int, speed: float, wrong: bool) -> None:
    rests = (speed, 0.0) if end == 0 else (0.0, speed)
    found = told(rests=rests)
    assert [row[:3] for row in found] == (
        [("velocity", (0, 3)[end], (0.0, 4.0)[end])] if wrong else []
    )


def test_jerks_and_jumps_of_acceleration() -> None:
    """At the limit of acceleration within the time asked for, and at no once."""
    assert told(jerk=column(4, at_2=10.0), jerk_time=0.5) == [
        ("jerk", 1, 1.0, 2.0, "rad/s³", "10.000 rad/s³ is more than 8.000 rad/s³")
    ]
    assert told(jumps=column(5, at_4=0.5), jerk_time=0.5) == [
        (
            "jerk",
            3,
            4.0,
            0.496,
            "rad/s² at once",
            "0.500 rad/s² at once is more than 0.004 rad/s² at once",
        )
    ]
    assert told(jumps=column(5, at_1=0.0039), jerk_time=0.5) == []
    assert [row[:3] for row in told(jumps=column(5, at_1=0.0041), jerk_time=0.5)] == [
        ("jerk", 0, 0.0)
    ]
    wild = {"jerk": column(4, at_2=99.0), "jumps": column(5, at_2=99.0)}
    assert told(**wild) == []  # type: ignore[arg-type]
    assert told(**wild, jerk_time=0.5, limits=(2.0, np.inf)) == []  # type: ignore[arg-type]
    assert len(told(**wild, jerk_time=0.5)) == 2  # type: ignore[arg-type]


# --- what bounds
# ------------------------------------------------------------------------------------------------------


def bounding(
    velocity: list[float],
    acceleration: list[float],
    torques: np.ndarray,
    *,
    jerk: list[float] | None = None,
    jerk_time: float = 0.0,
) -> list[tuple[Any, ...]]:
    """Return what bounds a motion of two coordinates; rates of the first, as shares of the limits 2 and 4, on each cubic."""
    rates = [
        np.column_stack([np.array(part) * limit, np.zeros(4)])
        for part, limit in ((velocity, 2.0), (acceleration, 4.0))
    ]
    jerks = np.column_stack([np.zeros(4) if jerk is None else np.array(jerk), np.zeros(4)])
    curve = SimpleNamespace(
        times=KNOTS, compute_max_rates=lambda: rates, compute_jerks=lambda: (jerks, None)
    )
    samples: Any = SimpleNamespace(
        trajectory=SimpleNamespace(curve=curve, names=("one", "two")),
        get_limits=lambda name: (0.0, 0.0, 2.0, 4.0),
    )
    moments: Any = SimpleNamespace(pieces=np.array([0, 1, 2, 3, 0, 1, 2, 3]))
    found = find_limiting_constraints(samples, moments, torques, jerk_time)
    return [(one.subject, one.kind, one.share, one.begin, one.end) for one in found]


NONE = np.zeros((8, 1))


def test_each_moment_is_of_the_limit_that_is_nearest() -> None:
    assert bounding([0.5, 0.5, 0.5, 0.2], [0.1, 0.9, 0.4, 0.9], NONE) == [
        ("one", "velocity", 0.625, 1.0, 3.0),
        ("one", "acceleration", 0.375, 3.0, 4.0),
    ]
    torques = np.zeros((8, 1))
    torques[6] = 0.75  # one moment of the third
    assert bounding([0.5, 0.5, 0.5, 0.5], [0.1] * 4, torques) == [
        ("one", "velocity", 0.5, 0.0, 1.0),
        ("one", "torque", 0.5, 1.0, 3.0),
    ]


def test_where_nothing_moves_it_rests() -> None:
    """However much a motor holds meanwhile."""
    heavy = np.full((8, 1), 0.9)
    assert bounding([0.0, 0.0, 1.0, 0.0], [0.0, 1e-12, 0.0, 0.0], heavy) == [
        ("one", "velocity", 0.5, 1.0, 3.0),
        ("", "rest", 0.5, 0.0, 1.0),
    ]


def test_jerks_count_as_far_as_they_are_limited() -> None:
    jerk = [8.0, 0.0, 0.0, 0.0]
    assert bounding([0.5] * 4, [0.1] * 4, NONE, jerk=jerk)[0][1:3] == ("velocity", 1.0)
    assert bounding([0.5] * 4, [0.1] * 4, NONE, jerk=jerk, jerk_time=0.2)[0][1:3] == (
        "velocity",
        1.0,
    )
    assert bounding([0.5] * 4, [0.1] * 4, NONE, jerk=jerk, jerk_time=0.5)[1] == (
        "one",
        "jerk",
        0.125,
        0.0,
        0.5,
    )


# --- torques
# ----------------------------------------------------------------------------------------------------------


def motors(
    torques: Any,
    limits: Any = (10.0, 20.0),
    *,
    known: bool = True,
    massless_objects: tuple[str, ...] = (),
    smooth: bool = True,
) -> Any:
    """Return motors that have these torques at four moments; a tenth of that at rest."""
    made = object.__new__(MotorLoads)
    numbers = np.array(torques, float)
    made.trajectory = SimpleNamespace(  # type: ignore[assignment]
        names=("slide", "turn"),
        times=TIMES,
        robot_size=2,
        curve=SimpleNamespace(times=KNOTS) if smooth else None,
    )
    made.samples = SimpleNamespace(get_unit=lambda name: "m" if name == "slide" else "rad")  # type: ignore[assignment]
    made.moments = SimpleNamespace(  # type: ignore[assignment, misc]
        times=np.array([0.0, 0.6, 2.0, 3.5]),
        pieces=np.array([0, 1, 2, 3]),
        positions=np.arange(4.0),
        velocities=np.full(4, 2.0),
        accelerations=np.full(4, 3.0),
    )

    def at(phases: Any, positions: Any, velocities: Any, accelerations: Any) -> np.ndarray:
        rows = positions.astype(int)
        full = np.allclose(velocities, 2.0) and np.allclose(accelerations, 3.0)
        assert full or (np.allclose(velocities, 0.02) and np.allclose(accelerations, 3e-4))
        assert phases.tolist() == [10 * made.waypoints[row] for row in rows]
        return np.asarray(numbers[rows] * (1.0 if full else 0.1))

    torque_limits = SimpleNamespace(
        is_known=known, limits=np.array(limits), notes=("nothing is stated",) if not known else ()
    )
    made._torques = SimpleNamespace(  # type: ignore[assignment]
        torque_limits=torque_limits,
        massless_objects=massless_objects,
        at=at,
        phases_of=lambda at: 10 * at,
    )
    return made


def test_the_worst_of_each_joint_is_named() -> None:
    made = motors([[1.0, 2.0], [-15.0, 2.0], [12.0, 2.0], [1.0, -300.0]])
    assert made.waypoints.tolist() == [0, 0, 1, 2]
    rows = [
        (one.constraint, one.subject, one.waypoint, one.time, one.amount, one.unit)
        for one in made.find_violations()
    ]
    assert rows == [("torque", "slide", 0, 0.6, 5.0, "N"), ("torque", "turn", 2, 3.5, 280.0, "N·m")]
    details = [one.detail for one in made.find_violations()]
    assert details == [
        "15 N exceeds the motor's 10 N, 1.5 N at rest",
        "300 N·m exceeds the motor's 20 N·m, 30 N·m even at rest",
    ]
    assert made.torque_ratios.max() == 15.0


@pytest.mark.parametrize(("share", "wrong"), [(1.0049, False), (1.0051, True)])
def test_half_a_hundredth_more_is_all_right(share: float, wrong: bool) -> None:
    assert (
        bool(motors([[0.0, 0.0], [0.0, 0.0], [-10.0 * share, 0.0], [0.0, 0.0]]).find_violations())
        == wrong
    )


def test_what_nobody_knows_is_no_share() -> None:
    made = motors([[99.0, 99.0]] * 4, known=False, massless_objects=("stick", "cup"))
    assert made.torque_ratios.tolist() == [[0.0, 0.0]] * 4
    assert made.find_violations() == []


def test_what_is_said_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        torques_module,
        "find_limiting_constraints",
        lambda samples, moments, shares, jerk_time: ("bounds", jerk_time),
    )
    assert motors([[1.0, 2.0], [-5.0, 2.0], [3.0, 2.0], [1.0, 2.0]]).summarize() == {
        "torque": 0.5,
        "bounds": ("bounds", 0.0),
        "remarks": (),
    }
    found = motors([[9.0, 9.0]] * 4, known=False, massless_objects=("stick", "cup")).summarize(0.25)
    assert found == {
        "torque": 0.0,
        "bounds": ("bounds", 0.25),
        "remarks": (
            "torques not checked: nothing is stated",
            "carried as massless, since no mass is given: stick, cup",
        ),
    }


def test_without_a_curve_every_waypoint_is_a_moment() -> None:
    """Its velocity is the mean of the steps around it; before the first and after the last it rests."""
    made = object.__new__(MotorLoads)
    rows = np.arange(8.0).reshape(4, 2)
    made.trajectory = SimpleNamespace(  # type: ignore[assignment]
        curve=None,
        times=TIMES,
        positions=rows,
        velocities=lambda: np.array([[1.0, 0.0], [3.0, 2.0], [5.0, -2.0]]),
        accelerations=lambda: -rows,
    )
    found = made.moments
    assert found.times.tolist() == TIMES.tolist()
    assert found.pieces.tolist() == [0, 1, 2, 2]
    assert found.positions.tolist() == rows.tolist()
    assert found.velocities.tolist() == [[0.5, 0.0], [2.0, 1.0], [4.0, 0.0], [2.5, -1.0]]
    assert found.accelerations.tolist() == (-rows).tolist()
    assert made.waypoints.tolist() == [0, 1, 2, 2]
