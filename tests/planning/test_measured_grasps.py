"""Tests plans that continue from a measured grasp, their validation and their files."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.drawers import make_grasping_scene

import vkc_pin as vkc
from vkc_pin.errors import InputError

PULL = vkc.Actuate("drawer", {"slide": 0.2})


def make_start(offset: float) -> vkc.Scene:
    """Return the drawer's scene with the base displaced by `offset` [m] from the nominal grasp."""
    scene = make_grasping_scene()
    return scene.with_start(base=scene.start[:3] + np.array([offset, 0.0, 0.0]))


@cache
def plan_measured() -> vkc.Plan:
    return vkc.plan(make_start(0.005).with_measured_grasp("drawer"), [PULL])


def test_drawer_held_beside_its_handle_is_opened(tmp_path: Path) -> None:
    plan = plan_measured()
    assert plan.success, plan.summary()
    assert np.linalg.norm(plan.scene.holds[0].deviation) == pytest.approx(0.005, abs=1e-5)
    end = plan.end_scene()  # the hand moves with the drawer, which opens along −x
    along = pin.SE3(np.eye(3), np.array([-end.objects["drawer"].state[0], 0.0, 0.0]))
    moved = along * plan.scene.tool_placement()
    np.testing.assert_allclose(end.tool_placement().homogeneous, moved.homogeneous, atol=1e-4)
    loaded = vkc.Plan.load(plan.save(tmp_path / "plan.npz"))
    assert loaded.success
    assert loaded.scene.holds == end.holds == plan.scene.holds


def test_another_measured_grasp_builds_nothing() -> None:
    """How an object is in the hand is data: one symbolic program serves all grasps."""
    planner = vkc.Planner()
    starts = [
        make_start(0.0),
        *(make_start(x).with_measured_grasp("drawer") for x in (0.005, -4e-3)),
    ]
    plans = [vkc.plan(start, [PULL], planner=planner) for start in starts]
    assert all(plan.success for plan in plans)
    assert [plan.statistics.build_time > 0.0 for plan in plans] == [True, False, False]


def test_nominal_grasp_applies_after_the_release() -> None:
    """A grasp step is satisfied by the measured grasp."""
    steps = [vkc.Grasp("drawer"), PULL, vkc.Release(), vkc.Actuate("drawer", {"slide": 0.1})]
    plan = vkc.plan(plan_measured().scene, steps)
    assert plan.success, plan.summary()
    holds = [phase.holds[0] for phase in plan.trajectory.phases if phase.holds]
    assert holds[0] == plan.scene.holds[0]
    assert holds[-1] == holds[0].nominal != holds[0]


def test_motion_must_keep_the_grasp_of_its_scene() -> None:
    plan, nominal = plan_measured(), make_start(0.005)
    phases = (dataclasses.replace(one, holds=nominal.holds) for one in plan.trajectory.phases)
    motion = dataclasses.replace(plan.trajectory, phases=tuple(phases))
    violations = vkc.validate(plan.scene, [PULL], motion).violations
    amounts = {one.constraint: one.amount for one in violations}
    assert amounts["closure"] == pytest.approx(0.004, abs=1e-5)
    for scene in (nominal, make_start(0.004).with_measured_grasp("drawer")):
        with pytest.raises(InputError, match=r"phases\[0\].deviation.*drawer.handle"):
            vkc.validate(scene, [PULL], plan.trajectory)


def test_infeasible_unmeasured_grasp_suggests_with_measured_grasp() -> None:
    (near, far) = (vkc.plan(make_start(offset), [PULL]) for offset in (0.005, 0.03))
    assert near.status == far.status == "infeasible"
    assert "see Scene.with_measured_grasp" in near.summary()
    assert "with_measured_grasp" not in far.summary()
    with pytest.raises(InputError, match=r"expected within 20 mm and 0.2 rad, got 30.0 mm"):
        make_start(0.03).with_measured_grasp("drawer")
