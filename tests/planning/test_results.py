"""Tests stationary plans, and repairs of curves until a check accepts them."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.carrying import describe_table, make_room
from helpers.drives import make_trajectory

import vkc_pin as vkc
from vkc_pin.planning.plan import PlanningStatistics
from vkc_pin.planning.request import PlanningRequest
from vkc_pin.planning.results import concatenate_plans, retime_validated
from vkc_pin.validation.report import Report, Violation
from vkc_pin.world.trajectory.trajectory import Trajectory


def test_plan_without_parts_is_stationary_and_keeps_the_grasped_object() -> None:
    scene = make_room(describe_table()).with_held({"stick": "grip"})
    request = PlanningRequest("auto", vkc.Options(), random_seed=3)
    statistics = [PlanningStatistics(1.5), PlanningStatistics(0.5, rounds=2)]
    plan = concatenate_plans(scene, [vkc.GoTo(0.3, 0.2)], request, [], statistics=statistics)
    assert (plan.status, plan.success, plan.seed) == ("interrupted", False, 3)
    assert {violation.constraint for violation in plan.report.violations} == {"goal"}
    assert np.ptp(plan.trajectory.positions, axis=0).max() == 0.0
    assert plan.trajectory.phases[0].held == {"stick": "grip"}
    assert plan.statistics == sum(statistics, start=PlanningStatistics())
    assert "FAILED, interrupted" in plan.summary()
    assert "interrupted" in plan._repr_html_()


def make_corner(scene: vkc.Scene) -> Trajectory:
    """Return waypoints of a base that drives ahead, and then to the left."""
    rows = np.tile(scene.start, (9, 1))
    rows[:, 0] += 0.2 * np.minimum(np.arange(9), 4)
    rows[:, 1] += 0.2 * np.maximum(np.arange(9) - 4, 0)
    return make_trajectory(scene, rows, dt=1.0)


def report_closure(*waypoints: int) -> Report:
    unit = {"amount": 1.0, "unit": "m", "detail": ""}
    return Report(tuple(Violation("closure", "door", waypoint=k, **unit) for k in waypoints))


def compute_deviation(scene: vkc.Scene, motion: Trajectory) -> np.ndarray:
    """Return the distance of the base from the two straight lines in every segment [m]."""
    deviations = []
    for begin, end in zip(motion.times, motion.times[1:], strict=False):
        x, y = (motion(np.linspace(begin, end, 50))[:, :2] - np.asarray(scene.start)[:2]).T
        deviations.append(np.maximum(np.minimum(np.abs(y), np.abs(x - 0.8)), x - 0.8).max())
    return np.array(deviations)


@pytest.mark.parametrize(("allowed", "max_checks"), [(1.0, 1), (5e-3, 4), (1e-9, 4)])
def test_repairs_reduce_the_deviation_until_the_check_accepts(
    allowed: float, max_checks: int
) -> None:
    scene, checked = vkc.load_scene("door"), list[float]()

    def check(motion: Trajectory) -> Report:
        deviations = compute_deviation(scene, motion)
        checked.append(float(deviations.max()))
        return report_closure(*np.flatnonzero(deviations > allowed).tolist())

    motion, report = retime_validated(scene, make_corner(scene), check)
    np.testing.assert_array_equal(motion.positions, make_corner(scene).positions)
    assert len(checked) <= max_checks
    assert checked == sorted(checked, reverse=True)
    assert report.ok == (allowed > 1e-6)
    assert compute_deviation(scene, motion).max() == checked[-1]


def test_curve_is_checked_once_without_repairs() -> None:
    scene, checked = vkc.load_scene("door"), list[Trajectory]()

    def check(motion: Trajectory) -> Report:
        checked.append(motion)
        return report_closure(0)

    motion, report = retime_validated(scene, make_corner(scene), check, repairs=0)
    assert checked == [motion]
    assert not report.ok
