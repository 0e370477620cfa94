"""Planning succeeds from poor initial guesses."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from helpers.drawers import load_drawer_scene
from helpers.drives import make_hall
from helpers.small_problems import load_door_scene

import vkc_pin as vkc

PILLAR = {
    "name": "pillar",
    "type": "cylinder",
    "radius": 0.15,
    "length": 1.6,
    "position": [1.2, 0.05, 0.8],
}


def test_reach_from_a_stationary_guess() -> None:
    start = load_door_scene().sample_start(np.random.default_rng(0))
    placed = start.objects["door"]
    attachment = placed.object.attachment()
    pose = placed.link_placement(attachment.link) * attachment.placement
    plan = vkc.plan(start, [vkc.Reach(pin.SE3(pose))], initialization="stationary", seed=0)
    assert plan.success, plan.summary()
    assert plan.initialization.startswith("stationary")


def test_actuation_from_a_stationary_guess() -> None:
    plan = vkc.plan(
        load_drawer_scene(),
        [vkc.Actuate("drawer", {"slide": 0.3})],
        initialization="stationary",
        seed=0,
    )
    assert plan.success, plan.summary()


def test_drive_from_a_perturbed_guess() -> None:
    options = vkc.Options(reach_waypoints=20)
    plan = vkc.plan(
        make_hall(obstacles=[PILLAR]),
        [vkc.GoTo(2.4, 0.0)],
        perturbation=0.5,
        seed=0,
        options=options,
    )
    assert plan.success, plan.summary()


@pytest.mark.parametrize(
    ("axis", "angle"),
    [([1.0, 0.0, 0.0], np.pi), ([0.0, 1.0, 0.0], np.pi - 1e-3), ([0.0, 0.0, 1.0], -2.9)],
)
def test_large_tool_rotation_from_a_stationary_guess(axis: list[float], angle: float) -> None:
    """At a stationary guess the residual's gradient vanishes or points along the longer turn."""
    scene = make_hall()
    tool = scene.tool_placement()
    shift = np.array([0.1, 0.1, 0.0])
    turned = pin.SE3(tool.rotation @ pin.exp3(angle * np.array(axis)), tool.translation + shift)
    options = vkc.Options(reach_waypoints=20)
    plan = vkc.plan(scene, [vkc.Reach(turned)], initialization="stationary", options=options)
    assert plan.success, plan.summary()
