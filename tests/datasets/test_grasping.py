from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from vkc_pin.datasets.problems import find_grasping_start
from vkc_pin.options import Options
from vkc_pin.planning.planner import Planner, plan
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Actuate

STEPS = {
    "drawer": Actuate("drawer", {"slide": 0.2}, "handle"),
    "door": Actuate("door", {"hinge": 0.6}, "handle"),
}


def compute_grasp_error(scene: Scene, name: str) -> float:
    """Return the largest deviation of the hand from its grasp [m] or [rad]."""
    (hold,) = scene.holds
    placed = scene.objects[name]
    grasp = placed.object.attachments[hold.attachment]
    expected = placed.link_placement(grasp.link) * grasp.tool(hold.at)
    return float(np.abs(pin.log6(expected.actInv(scene.tool_placement())).vector).max())


@pytest.mark.parametrize("name", ["drawer", "door"])
def test_grasping_start_places_the_hand_at_the_attachment(name: str) -> None:
    scene = load_scene(name)
    step = Actuate(name, STEPS[name].joints, next(iter(scene.objects[name].object.attachments)))
    rng, planner = np.random.default_rng(0), Planner()
    bases = []
    for _ in range(4):
        found = find_grasping_start(scene, step, rng, Options(), planner)
        assert found is not None
        assert compute_grasp_error(found, name) < 1e-5
        assert found.held == {name: step.attachment}
        bases.append(tuple(found.start[:3]))
    assert len(set(bases)) == 4
    assert plan(found, [step], planner=planner).success


def test_blocked_grasp_has_no_grasping_start() -> None:
    scene = load_scene("drawer")
    document = scene.document
    attachment, placed = (
        next(iter(scene.objects["drawer"].object.attachments)),
        scene.objects["drawer"],
    )
    position = placed.link_placement(
        placed.object.attachments[attachment].link
    ).translation.tolist()
    document["obstacles"].append(
        {"name": "block", "type": "box", "size": [1.0, 1.0, 1.0], "position": position}
    )
    with pytest.warns(UserWarning, match="overlap other shapes"):
        blocked = Scene.from_document(document, scene.folder)
    step = Actuate("drawer", {"slide": 0.2}, attachment)
    assert (
        find_grasping_start(blocked, step, np.random.default_rng(0), Options(), Planner()) is None
    )
