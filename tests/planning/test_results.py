"""Tests the stationary plan that replaces a plan without parts."""

from __future__ import annotations

import pytest
from helpers.carrying import describe_table, make_room

import vkc_pin as vkc
from vkc_pin.planning.plan import PlanningStatistics
from vkc_pin.planning.request import PlanningRequest
from vkc_pin.planning.results import concatenate_plans


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
