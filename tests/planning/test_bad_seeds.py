"""Seeds from which a motion is far away: nothing moves, everything shakes, the hand is turned right round."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from helpers.drawers import drawer_scene
from helpers.drives import hall
from helpers.small_problems import door_scene

import vkc_pin as vkc

PILLAR = {
    "name": "pillar",
    "type": "cylinder",
    "radius": 0.15,
    "length": 1.6,
    "position": [1.2, 0.05, 0.8],
}


@pytest.mark.parametrize("seed", range(3))
def test_a_handle_is_reached_by_a_robot_that_stands_still(seed: int) -> None:
    start = door_scene().sample_start(np.random.default_rng(seed))
    placed = start.objects["door"]
    attachment = placed.object.attachment()
    pose = placed.link_placement(attachment.link) * attachment.placement
    plan = vkc.plan(start, [vkc.Reach(pin.SE3(pose))], initialization="stationary", seed=seed)
    assert plan.success, plan.summary()
    assert plan.initialization.startswith("stationary")


@pytest.mark.parametrize("seed", range(3))
def test_a_drawer_is_pulled_by_a_robot_that_stands_still(seed: int) -> None:
    """In as many waypoints as usual: where few have to do, ways between them are long and lead through things."""
    plan = vkc.plan(
        drawer_scene(),
        [vkc.Actuate("drawer", {"slide": 0.3})],
        initialization="stationary",
        seed=seed,
    )
    assert plan.success, plan.summary()


@pytest.mark.parametrize("seed", range(2))
def test_a_seed_that_shakes_by_half_a_metre(seed: int) -> None:
    options = vkc.Options(reach_waypoints=20)
    plan = vkc.plan(
        hall(obstacles=[PILLAR]), [vkc.GoTo(2.4, 0.0)], perturbation=0.5, seed=seed, options=options
    )
    assert plan.success, plan.summary()


@pytest.mark.parametrize("axis", [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
@pytest.mark.parametrize("angle", [np.pi, np.pi - 1e-3, -2.9])
def test_the_hand_turns_right_round(axis: list[float], angle: float) -> None:
    """From a seed in which nothing moves: there the residual's slope is zero, or leads the long way."""
    scene = hall()
    tool = scene.tool_placement()
    turned = pin.SE3(
        tool.rotation @ pin.exp3(angle * np.array(axis)),
        tool.translation + np.array([0.1, 0.1, 0.0]),
    )
    plan = vkc.plan(
        scene,
        [vkc.Reach(turned)],
        initialization="stationary",
        options=vkc.Options(reach_waypoints=20),
    )
    assert plan.success, plan.summary()
