"""Tests that durations are near their lower bound, and that the bound is tight."""

from __future__ import annotations

import dataclasses

import pytest
from helpers.executions import plan_door, plan_drawer

import vkc_pin as vkc
from optimal.bound import compute_bound
from vkc_pin.planning.retiming.retime import retime_trajectory


@pytest.mark.parametrize("make_plan", [plan_door, plan_drawer])
def test_duration_is_at_most_5_percent_above_the_bound(make_plan: object) -> None:
    plan: vkc.Plan = make_plan()  # type: ignore[operator]
    least, torque_bound = compute_bound(plan.scene, plan.trajectory)
    assert least <= plan.trajectory.times[-1] <= 1.05 * least
    assert torque_bound == 0


def test_bound_converges_with_the_grid() -> None:
    plan = plan_drawer()
    coarse, fine, finest = (
        compute_bound(plan.scene, plan.trajectory, points)[0] for points in (5, 40, 80)
    )
    assert finest < fine < coarse
    assert fine - finest < 0.1 * (coarse - fine)


def test_bound_depends_on_limits() -> None:
    """A quarter of the acceleration and half the velocity limits increase the least duration."""
    plan = plan_drawer()
    robot = plan.scene.robot
    weak = dataclasses.replace(
        robot, acceleration=robot.acceleration / 4.0, velocity=robot.velocity / 2.0
    )
    scene = dataclasses.replace(plan.scene, robot=weak)
    slow = retime_trajectory(scene, plan.trajectory)
    assert compute_bound(scene, slow)[0] > 1.5 * compute_bound(plan.scene, plan.trajectory)[0]
    with pytest.raises(AssertionError, match="another one"):
        compute_bound(scene, plan.trajectory)
