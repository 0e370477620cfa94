"""Motions take hardly longer than the fastest along their paths; the bound is one."""

from __future__ import annotations

import dataclasses

import pytest
from helpers.executions import plan_door, plan_drawer

import vkc_pin as vkc
from optimal.bound import compute_bound
from vkc_pin.planning.retiming.retime import retime_trajectory


@pytest.mark.parametrize("made", [plan_door, plan_drawer])
def test_durations_are_near_the_least_ones(made: object) -> None:
    plan: vkc.Plan = made()  # type: ignore[operator]
    least, heavy = compute_bound(plan.scene, plan.trajectory)
    assert least <= plan.trajectory.times[-1] <= 1.05 * least
    assert heavy == 0


def test_bound_converges_with_the_grid() -> None:
    plan = plan_drawer()
    coarse, fine, finest = (
        compute_bound(plan.scene, plan.trajectory, places)[0] for places in (5, 40, 80)
    )
    assert finest < fine < coarse
    assert fine - finest < 0.1 * (coarse - fine)


def test_bound_depends_on_limits() -> None:
    """A quarter of the acceleration and half the velocity increase the least duration."""
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
