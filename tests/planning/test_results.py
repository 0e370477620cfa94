"""Tests stationary plans, and repairs of curves until a check accepts them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from helpers.carrying import describe_table, make_room

import vkc_pin as vkc
from vkc_pin.planning.plan import PlanningStatistics
from vkc_pin.planning.request import PlanningRequest
from vkc_pin.planning.results import concatenate_plans, retime_validated
from vkc_pin.world.trajectory.trajectory import Trajectory


@pytest.mark.parametrize("name", ["household"])
def test_plan_without_parts_is_stationary(name: str) -> None:
    scene = vkc.load_scene(name)
    request = PlanningRequest("auto", vkc.Options(), random_seed=3)
    statistics = [PlanningStatistics(1.5), PlanningStatistics(0.5, rounds=2)]
    plan = concatenate_plans(scene, [vkc.GoTo(0.3, 0.2)], request, [], statistics=statistics)
    assert (plan.status, plan.success, plan.seed) == ("interrupted", False, 3)
    assert {violation.constraint for violation in plan.report.violations} == {"goal"}
    assert (plan.trajectory.positions == plan.trajectory.positions[0]).all()
    assert (plan.metrics["planning_time"], plan.metrics["rounds"], plan.metrics["time_coal"]) == (
        2.0,
        2.0,
        0.0,
    )
    assert "FAILED, interrupted" in plan.summary()
    assert "interrupted" in plan._repr_html_()


def test_stationary_plan_keeps_the_grasped_object() -> None:
    scene = make_room(describe_table())
    attachment = next(iter(scene.objects["stick"].object.attachments))
    held = scene.with_held({"stick": attachment})
    plan = concatenate_plans(held, [vkc.GoTo(0.3, 0.2)], PlanningRequest("auto", vkc.Options()), [])
    assert plan.trajectory.phases[0].held == {"stick": attachment}
    assert "unheld" not in {violation.constraint for violation in plan.report.violations}


@dataclasses.dataclass(frozen=True)
class FakeViolation:
    waypoint: int
    constraint: str = "closure"


@dataclasses.dataclass(frozen=True)
class FakeReport:
    violations: tuple[FakeViolation, ...]

    @property
    def ok(self) -> bool:
        return not self.violations


def make_corner(scene: vkc.Scene) -> Trajectory:
    """Return waypoints of a base that drives ahead, and then to the left."""
    rows = np.tile(scene.start, (9, 1))
    rows[:, 0] += 0.2 * np.minimum(np.arange(9), 4)
    rows[:, 1] += 0.2 * np.maximum(np.arange(9) - 4, 0)
    return Trajectory(
        scene.robot.coordinates.names,
        np.arange(9.0),
        rows,
        (vkc.PhaseSpan("go", 0, 8),),
        rows.shape[1],
    )


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

    def check(motion: Trajectory) -> FakeReport:
        deviations = compute_deviation(scene, motion)
        checked.append(float(deviations.max()))
        return FakeReport(
            tuple(FakeViolation(int(k)) for k in np.flatnonzero(deviations > allowed))
        )

    motion, report = retime_validated(scene, make_corner(scene), check)
    np.testing.assert_array_equal(motion.positions, make_corner(scene).positions)
    assert len(checked) <= max_checks
    assert checked == sorted(checked, reverse=True)
    assert report.ok == (allowed > 1e-6)
    assert compute_deviation(scene, motion).max() == checked[-1]


def test_curve_is_checked_once_without_repairs() -> None:
    scene, checked = vkc.load_scene("door"), list[Trajectory]()

    def check(motion: Trajectory) -> FakeReport:
        checked.append(motion)
        return FakeReport((FakeViolation(0),))

    motion, report = retime_validated(scene, make_corner(scene), check, repairs=0)
    assert checked == [motion]
    assert not report.ok
