"""Tests that violations of velocity, acceleration and jerk limits state their amount."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from helpers.executions import plan_drawer

import vkc_pin as vkc
from vkc_pin.planning.retiming.retime import retime_trajectory
from vkc_pin.validation.limits import check_rates
from vkc_pin.validation.report import Violation
from vkc_pin.validation.samples import Samples
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.trajectory import PhaseSpan, Trajectory


def find_violations(motion: Trajectory, **options: float) -> dict[tuple[str, str], Violation]:
    rows = check_rates(Samples(plan_drawer().scene, motion), vkc.Options(**options))  # type: ignore[arg-type]
    return {(row.constraint, row.unit): row for row in rows if row.subject == "elbow_joint"}


def retime_smoothly() -> Trajectory:
    plan = plan_drawer()
    return retime_trajectory(plan.scene, plan.trajectory, jerk_time=0.2)


def test_jerk_violation_is_reported() -> None:
    motion = retime_smoothly()
    assert not find_violations(motion, jerk_time=0.2)
    assert not find_violations(motion)
    assert not find_violations(plan_drawer().trajectory)
    (kind,) = find_violations(motion, jerk_time=1.0)
    assert kind == ("jerk", "rad/s³")
    assert motion.curve is not None
    strongest = motion.curve.compute_jerks()[0][:, motion.names.index("elbow_joint")].max()
    assert find_violations(motion, jerk_time=1.0)[kind].amount == pytest.approx(
        strongest - 1.4 / 1.0
    )


def move_elbow(share: float) -> Trajectory:
    """Move the elbow by one cubic, with `share` of its largest acceleration, 1.4 rad/s²."""
    plan = plan_drawer()
    motion, elbow = plan.trajectory, plan.trajectory.names.index("elbow_joint")
    rows = np.tile(motion.positions[0], (2, 1))
    rows[1, elbow] += share * 1.4 / 6.0 * 2.0**2  # 3s² − 2s³ in 2 s has 6 / 2² at its ends
    times = np.array([0.0, 2.0])
    curve = Curve(times, rows, np.zeros_like(rows))
    return Trajectory(
        motion.names, times, rows, (PhaseSpan("move", 0, 1),), motion.robot_size, curve
    )


@pytest.mark.parametrize(
    ("share", "kinds"), [(1.0005, set()), (1.0015, {"acceleration"}), (0.5, set())]
)
def test_rates_within_the_tolerance_are_accepted(share: float, kinds: set[str]) -> None:
    assert {kind for kind, _ in find_violations(move_elbow(share))} == kinds


@pytest.mark.parametrize(("speed", "rests"), [(0.9e-6, True), (1.5e-6, False)])
@pytest.mark.parametrize("end", [0, -1])
def test_motion_must_begin_and_end_at_rest(speed: float, rests: bool, end: int) -> None:
    motion = move_elbow(0.1)
    assert motion.curve is not None
    rates = motion.curve.rates.copy()
    rates[end, motion.names.index("elbow_joint")] = speed
    curve = Curve(motion.curve.times, motion.curve.positions, rates)
    rows = find_violations(dataclasses.replace(motion, curve=curve))
    assert (not rows) == rests
    if not rests:
        (row,) = rows.values()
        assert (row.constraint, row.waypoint) == ("velocity", 0 if end == 0 else 1)


def test_acceleration_jumps_are_reported() -> None:
    motion = plan_drawer().trajectory
    assert motion.curve is not None
    jumps = motion.curve.compute_jerks()[1][:, motion.names.index("elbow_joint")]
    violation = find_violations(motion, jerk_time=0.005)["jerk", "rad/s² at once"]
    assert violation.amount == pytest.approx(jumps.max() - 1.4e-3)
    at = motion.curve.times[int(np.argmax(jumps))]
    assert (
        motion.times[violation.waypoint]
        <= at
        <= motion.times[min(violation.waypoint + 1, len(motion.times) - 1)]
    )


def test_motion_three_times_as_fast_violates_all_rate_limits() -> None:
    motion = retime_smoothly()
    assert motion.curve is not None
    quick = Curve(motion.curve.times / 3.0, motion.curve.positions, motion.curve.rates * 3.0)
    rows = check_rates(
        Samples(
            plan_drawer().scene, dataclasses.replace(motion, times=motion.times / 3.0, curve=quick)
        ),
        vkc.Options(jerk_time=0.2),
    )
    assert {row.constraint for row in rows} == {"velocity", "acceleration", "jerk"}


def test_jerk_bounds_the_duration() -> None:
    plan = plan_drawer()
    report = vkc.validate(plan.scene, plan.steps, retime_smoothly(), vkc.Options(jerk_time=0.2))
    assert report.ok
    assert "jerk" in {bound.kind for bound in report.bounds}
    assert "jerk" not in {bound.kind for bound in plan.report.bounds}
