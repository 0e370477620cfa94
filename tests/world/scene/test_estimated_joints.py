"""Tests scenes whose joints were measured elsewhere than described."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import vkc_pin as vkc
from vkc_pin.world.scene.estimated_joints import find_axis

CASES = [
    ("door", "door", "hinge", "panel"),
    ("door", "door", "hinge", "lever"),
    ("door", "door", "knob", "lever"),
    ("drawer", "drawer", "slide", "tray"),
]


def estimate(scene: vkc.Scene, name: str, joint: str, link: str) -> vkc.JointEstimate:
    """Return a joint 30 mm and 4° from where a scene has it, of a link that is elsewhere, too."""
    placed = scene.objects[name]
    kind, axis, point = find_axis(placed, joint)
    across = np.cross(axis, [0.6, -0.3, 0.2])
    across /= np.linalg.norm(across)
    noise = pin.exp6(np.array([0.002, -0.001, 0.003, 0.01, -0.02, 0.015]))
    return vkc.JointEstimate(
        kind=kind,
        axis=-pin.exp3(0.07 * across) @ axis,  # a line has two directions
        point=point + 0.03 * across,
        link=placed.link_placement(link) * noise,
        positions=np.zeros(1),
        axis_deviation=0.0,
        point_deviation=0.0,
        information={},
    )


def load(name: str) -> vkc.Scene:
    """Return a scene whose object is elsewhere, turned, and open."""
    scene = vkc.load_scene(name)
    scene = scene.with_placement(name, [2.2, 0.1, 0.05, 0.02, -0.03, 0.4])
    state = {"hinge": 0.3, "knob": 0.2} if name == "door" else {"slide": 0.15}
    return scene.with_state(name, state)


@pytest.mark.parametrize(("scene_name", "name", "joint", "link"), CASES)
def test_link_moves_on_the_estimated_axis(
    scene_name: str, name: str, joint: str, link: str
) -> None:
    scene = load(scene_name)
    found = estimate(scene, name, joint, link)
    value = float(scene.objects[name].state[scene.objects[name].object.coordinates.index(joint)])
    changed = scene.with_measured_joint(name, joint, found, link=link)
    np.testing.assert_array_equal(changed.objects[name].state, scene.objects[name].state)
    _, described, _ = find_axis(scene.objects[name], joint)
    _, axis, _ = find_axis(changed.objects[name], joint)
    assert axis @ described > 0.99  # the sense of the joint is that of the description
    for step in (0.0, 0.1, -0.1):
        there = changed.with_state(name, {joint: value + step}).objects[name]
        expected = found.compute_placement(-step)  # the estimate has the other direction
        assert there.link_placement(link).isApprox(expected, 1e-12)


def test_all_that_a_joint_carries_moves_with_it() -> None:
    scene = load("door")
    found = estimate(scene, "door", "hinge", "panel")
    changed = scene.with_measured_joint("door", "hinge", found)
    before, after = scene.objects["door"], changed.objects["door"]
    panel_before, panel = before.link_placement("panel"), after.link_placement("panel")
    lever_before, lever = before.link_placement("lever"), after.link_placement("lever")
    assert panel.actInv(lever).isApprox(panel_before.actInv(lever_before), 1e-12)
    for own, other in (("collision", "panel"), ("visual", "lever")):
        frames = (before.link_placement(other), after.link_placement(other))
        placements = []
        for placed, frame in zip((before, after), frames, strict=True):
            model = placed.object.model
            data = model.createData()
            pin.forwardKinematics(model, data, placed.object.coordinates.q(placed.state))
            shapes = getattr(placed.object, own).geometryObjects
            shape = next(one for one in shapes if one.name.startswith(other))
            world = placed.placement * data.oMi[shape.parentJoint] * shape.placement
            placements.append(frame.actInv(world))
        assert placements[0].isApprox(placements[1], 1e-12)
    # The centre of mass of the panel
    centres = []
    for placed, frame in ((before, panel_before), (after, panel)):
        model = placed.object.model
        data = model.createData()
        pin.forwardKinematics(model, data, placed.object.coordinates.q(placed.state))
        joint = placed.find_joint("hinge")
        centre = (placed.placement * data.oMi[joint]).act(model.inertias[joint].lever)
        centres.append(frame.actInv(centre))
    np.testing.assert_allclose(centres[0], centres[1], atol=1e-12)
    assert after.object.lower.tolist() == before.object.lower.tolist()
    assert after.object.coordinates.names == before.object.coordinates.names


def test_measured_joints_survive_other_changes_and_files(tmp_path: Path) -> None:
    scene = load("door")
    for joint in ("hinge", "knob", "hinge"):  # a second measurement replaces the first
        found = estimate(scene, "door", joint, "lever")
        scene = scene.with_measured_joint("door", joint, found, link="lever")
    link = scene.objects["door"].link_placement("lever")
    assert link.isApprox(found.link, 1e-12)
    base = scene.objects["door"].placement
    moved = pin.SE3(np.eye(3), np.array([0.1, 0.2, 0.0])) * base
    elsewhere = scene.with_placement("door", moved).objects["door"].link_placement("lever")
    assert moved.actInv(elsewhere).isApprox(base.actInv(link), 1e-12)
    document = scene.document
    loaded = vkc.Scene.from_document(document, scene.folder)
    assert (
        loaded.document["objects"] == vkc.Scene.from_document(loaded.document).document["objects"]
    )
    for state in ({"hinge": 0.0}, {"hinge": 0.9, "knob": 0.5}):
        one = scene.with_state("door", state).objects["door"].link_placement("lever")
        other = loaded.with_state("door", state).objects["door"].link_placement("lever")
        assert one.isApprox(other, 1e-12)
    document["objects"][0]["measured"]["hinges"] = document["objects"][0]["measured"].pop("hinge")
    with pytest.raises(vkc.UnknownNameError, match=r"measured.hinges.*hinge"):
        vkc.Scene.from_document(document, scene.folder)


def test_measured_joint_is_planned_without_building_anything() -> None:
    planner = vkc.Planner()
    steps = [vkc.Actuate("drawer", {"slide": 0.3})]
    scene = vkc.load_scene("drawer")
    nominal = vkc.plan(scene, steps, planner=planner)
    found = estimate(scene, "drawer", "slide", "tray")
    changed = scene.with_measured_joint("drawer", "slide", found, link="tray")
    plan = vkc.plan(changed, steps, planner=planner)
    assert plan.success, plan.summary()
    assert [one.statistics.build_time > 0.0 for one in (nominal, plan)] == [True, False]
    moved = plan.pose(None, plan.trajectory.times[-1]).translation
    moved = moved - plan.pose(None, plan.trajectory.times[-8]).translation
    assert abs(moved @ found.axis) == pytest.approx(np.linalg.norm(moved), rel=1e-3)


@pytest.mark.parametrize(
    ("scene_name", "arguments", "options", "error", "message"),
    [
        ("door", ("doors", "hinge"), {}, vkc.UnknownNameError, "doors.*door"),
        ("door", ("door", "hinges"), {}, vkc.UnknownNameError, "hinges.*hinge"),
        ("door", ("door", "hinge"), {"link": "leaf"}, vkc.UnknownNameError, "leaf"),
        ("door", ("door", "knob"), {"link": "panel"}, vkc.InputError, "does not move.*panel"),
        (
            "drawer",
            ("drawer", "slide"),
            {},
            vkc.InputError,
            "another kind.*prismatic, as",
        ),
        ("door", ("door", "hinge"), {"value": np.nan}, vkc.InputError, "value"),
    ],
)
def test_misuse_is_named(
    scene_name: str,
    arguments: tuple[str, str],
    options: dict[str, Any],
    error: type[Exception],
    message: str,
) -> None:
    found = estimate(load("door"), "door", "hinge", "panel")
    with pytest.raises(error, match=message):
        load(scene_name).with_measured_joint(*arguments, found, **options)


def test_joints_of_free_objects_cannot_be_measured() -> None:
    found = estimate(load("door"), "door", "hinge", "panel")
    description = dict(vkc.load_scene("door").document)
    item = dict(description["objects"][0])
    folder = Path(vkc.__file__).resolve().parents[1] / "scenes" / "objects"
    item["type"] = {
        "urdf": str(folder / "door.urdf"),
        "free": True,
        "attachments": [{"name": "handle", "link": "lever"}],
    }
    description["objects"] = [item]
    scene = vkc.Scene.from_document(description)
    with pytest.raises(vkc.InputError, match="fixed in the world"):
        scene.with_measured_joint("door", "hinge", found)
