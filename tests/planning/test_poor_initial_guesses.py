"""Planning succeeds from poor initial guesses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.drawers import load_drawer_scene
from helpers.drives import make_hall
from helpers.small_problems import load_door_scene

import vkc_pin as vkc

FEW = vkc.Options(reach_waypoints=20)


def plan_stationary(scene: vkc.Scene, step: vkc.steps.Step, **options: Any) -> None:
    plan = vkc.plan(scene, [step], initialization="stationary", **options)
    assert plan.success, plan.summary()
    assert plan.initialization.startswith("stationary")


def test_reach_from_a_stationary_guess() -> None:
    start = load_door_scene().sample_start(np.random.default_rng(0))
    placed = start.objects["door"]
    attachment = placed.object.attachment()
    pose = placed.link_placement(attachment.link) * attachment.placement
    plan_stationary(start, vkc.Reach(pin.SE3(pose)))


def test_actuation_from_a_stationary_guess() -> None:
    plan_stationary(load_drawer_scene(), vkc.Actuate("drawer", {"slide": 0.3}))


def test_drive_from_a_perturbed_guess() -> None:
    pillar = {"name": "pillar", "type": "cylinder", "radius": 0.15, "length": 1.6}
    scene = make_hall(obstacles=[{**pillar, "position": [1.2, 0.05, 0.8]}])
    plan = vkc.plan(scene, [vkc.GoTo(2.4, 0.0)], perturbation=0.5, options=FEW)
    assert plan.success, plan.summary()


@pytest.mark.parametrize(
    ("axis", "angle"),
    [([1.0, 0.0, 0.0], np.pi), ([0.0, 1.0, 0.0], np.pi - 1e-3), ([0.0, 0.0, 1.0], -2.9)],
)
def test_large_tool_rotation_from_a_stationary_guess(axis: list[float], angle: float) -> None:
    """At a stationary guess the residual's gradient vanishes or points along the longer turn."""
    tool = make_hall().tool_placement()
    shift = np.array([0.1, 0.1, 0.0])
    turned = pin.SE3(tool.rotation @ pin.exp3(angle * np.array(axis)), tool.translation + shift)
    plan_stationary(make_hall(), vkc.Reach(turned), options=FEW)
