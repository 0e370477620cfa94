"""Tests the scene check: close pairs, reachable attachments and frame directions."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.drawers import add_boxes, load_drawer_scene, replace_scene_fields
from helpers.drives import make_trajectory

import vkc_pin as vkc
from vkc_pin.errors import InputError
from vkc_pin.planning.scene_check import SceneCheck, check_scene
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.scene import Scene

DRAWER = load_drawer_scene().objects["drawer"].object


def keep_attachment(scene: Scene, name: str, attachment: str) -> Scene:
    """Return a scene whose only object has a single attachment."""
    placed = scene.objects[name]
    kept = {attachment: placed.object.attachments[attachment]}
    only = dataclasses.replace(placed.object, attachments=kept)
    return dataclasses.replace(scene, objects={name: dataclasses.replace(placed, object=only)})


@pytest.fixture(scope="module")
def drawer_check() -> SceneCheck:
    return check_scene(load_drawer_scene())


def test_free_scene_has_no_problems(drawer_check: SceneCheck) -> None:
    check = drawer_check
    assert check.ok
    assert [*check.robot, *check.close, *check.allowed, *check.problems, *check.warnings] == []
    assert [one.attachment for one in check.attachments] == list(DRAWER.attachments)
    for one in check.attachments:
        np.testing.assert_allclose(one.approach, [1.0, 0.0, 0.0], atol=1e-9)
        np.testing.assert_allclose(one.closing, [0.0, 0.0, 1.0], atol=1e-9)


def test_reachable_configurations_are_valid(drawer_check: SceneCheck) -> None:
    scene = load_drawer_scene()
    grasps = {name for name, one in DRAWER.attachments.items() if one.contact == "grasp"}
    for one in (one for one in drawer_check.attachments if one.attachment in grasps):
        assert one.configuration is not None
        there = scene.with_start(base=one.configuration[:3], arm=one.configuration[3:])
        still = make_trajectory(there, np.tile(one.configuration, (2, 1)))
        report = validate(there, [vkc.Reach(there.tool_placement())], still)
        assert report.ok, report.lines()
        assert report.clearance >= 0.005 - 1e-6  # between the hand and the drawer
        assert one.clearance >= 0.02


def test_blocked_attachments_name_the_obstacle() -> None:
    scene = add_boxes(load_drawer_scene(), box=((0.2, 1.6, 1.2), (1.66, 0.0, 0.6)))
    blocked = check_scene(keep_attachment(scene, "drawer", "handle"))
    assert not blocked.ok
    assert all(one.configuration is None and "box" in one.because for one in blocked.attachments)
    assert any("not reached" in line for line in blocked.lines())


def test_unreachable_attachments_are_reported() -> None:
    (drawer,) = load_drawer_scene().document["objects"]
    raised = {**drawer, "position": [1.93, 0.0, 2.0]}
    high = check_scene(replace_scene_fields(load_drawer_scene(), objects=[raised]))
    assert not high.ok
    assert [one.configuration for one in high.attachments] == [None] * len(DRAWER.attachments)


def test_grasped_objects_are_not_checked() -> None:
    cup = {"name": "cup", "type": "cup", "position": [0.0, 0.0, 1.5]}
    objects = [*load_drawer_scene().document["objects"], cup]
    scene = replace_scene_fields(load_drawer_scene(), objects=objects)
    held = check_scene(scene.with_held({"cup": "side"}))
    assert {one.object for one in held.attachments} == {"drawer"}
    assert any(one.configuration is not None for one in held.attachments)


def test_overlaps_and_close_pairs_are_reported(tmp_path: Path) -> None:
    x, y, _ = load_drawer_scene().start[:3]
    scene = add_boxes(
        load_drawer_scene(),
        side=((0.6, 0.1, 0.9), (2.0, 0.295 + 0.05 + 0.004, 0.45)),
        post=((0.1, 0.1, 1.0), (x, y, 0.5)),
    )
    found = check_scene(keep_attachment(scene, "drawer", "handle"))
    assert not found.ok
    assert found.problems
    assert all("post" in line and "overlap" in line for line in found.problems)
    assert {pair.second for pair in found.robot if pair.distance < 0.0} == {"post"}
    assert [pair[:2] for pair in found.close] == [("drawer.tray", "side")]
    assert [(one.first, one.second) for one in found.allowed] == [("drawer.tray", "side")]
    text = str(found)
    assert "drawer.tray – side are 4.0 mm apart" in text
    assert "nothing can be planned, because" in text
    found.plot(tmp_path / "scene.png")
    assert (tmp_path / "scene.png").read_bytes()[:4] == b"\x89PNG"
    with pytest.raises(InputError, match="not the name of a picture"):
        found.plot(tmp_path / "scene.txt")


def test_close_pairs_of_the_robot_are_measured_nearest_first() -> None:
    """The robot's body is 0.99 m long and 0.67 m wide."""
    scene = load_drawer_scene().with_start(base=[-0.8, 0.5, 0.0])
    size = (0.1, 0.1, 0.4)
    boxes = {
        "left": (size, (-0.8, 0.5 + 0.335 + 0.05 + 0.015, 0.2)),
        "front": (size, (-0.8 + 0.495 + 0.05 + 0.005, 0.5, 0.2)),
        "right": (size, (-0.8, 0.5 - 0.335 - 0.05 - 0.010, 0.2)),
        "far": (size, (-0.8 - 0.495 - 0.05 - 0.021, 0.5, 0.2)),
    }
    found = check_scene(keep_attachment(add_boxes(scene, **boxes), "drawer", "handle"))
    assert [pair[:2] for pair in found.robot] == [
        ("base_link", "front"),
        ("base_link", "right"),
        ("base_link", "left"),
    ]
    distances = [pair.distance for pair in found.robot]
    np.testing.assert_allclose(distances, [0.005, 0.010, 0.015], atol=1e-4)
    assert "the robot is closer than 20 mm to" in str(found)


def test_clearance_of_the_options_decides_what_is_close_and_exempt() -> None:
    beside = ((0.6, 0.1, 0.9), (2.0, 0.295 + 0.05 + 0.03, 0.45))
    scene = keep_attachment(add_boxes(load_drawer_scene(), side=beside), "drawer", "handle")
    usual = check_scene(scene)
    assert usual.allowed == usual.close == ()
    more = check_scene(scene, options=vkc.Options(dist_safe=0.05))
    assert [(one.first, one.second) for one in more.allowed] == [("drawer.tray", "side")]
    (pair,) = more.close
    assert pair.distance == pytest.approx(0.03, abs=1e-6)
    text = str(more)
    assert "closer than 50 mm to each other" in text
    assert "one in the other" not in text


def test_overlapping_objects_are_listed_apart_from_close_ones() -> None:
    boxes = {
        "inside": ((0.6, 0.1, 0.9), (2.0, 0.295 + 0.05 - 0.004, 0.45)),
        "beside": ((0.6, 0.1, 0.9), (2.0, -0.295 - 0.05 - 0.004, 0.45)),
    }
    with pytest.warns(UserWarning, match="inside"):
        scene = add_boxes(load_drawer_scene(), **boxes)
    lines = check_scene(keep_attachment(scene, "drawer", "handle")).lines()
    close, overlapping, after = (
        next(k for k, line in enumerate(lines) if title in line)
        for title in ("to each other", "one in the other", "may be close")
    )
    assert close < overlapping < after
    assert [line for line in lines[close:overlapping] if "beside" in line]
    assert not [line for line in lines[close:overlapping] if "inside" in line]
    assert [line for line in lines[overlapping:after] if "inside" in line]
    assert not [line for line in lines[overlapping:after] if "beside" in line]


def test_reported_clearance_is_that_of_what_is_not_grasped() -> None:
    """The closed hand is 5.3 mm from the cup; other grasps of the same sample are closer."""
    scene = load_cup_scene("side")
    (one,) = check_scene(scene).attachments
    assert one.clearance > vkc.Options().dist_safe
    (other,) = check_scene(scene, seed=1).attachments
    assert not np.array_equal(one.configuration, other.configuration)


def make_small_arena() -> Scene:
    arena = {"x": [-1.2, -0.4], "y": [0.1, 0.9]}
    fields = {"arena": arena, "start_region": arena, "objects": []}
    return replace_scene_fields(load_drawer_scene(), **fields)


def make_cell() -> Scene:
    boxes = [((0.1, 2.2, 1.0), (x, 0.5, 0.5)) for x in (-1.6, 0.0)]
    boxes += [((2.2, 0.1, 1.0), (-0.8, y, 0.5)) for y in (-0.3, 1.3)]
    empty = replace_scene_fields(load_drawer_scene(), objects=[])
    return add_boxes(empty, **{f"wall_{k}": box for k, box in enumerate(boxes)})


@pytest.mark.parametrize("make_scene", [make_small_arena, make_cell])
def test_small_reachable_floor_area_is_reported(make_scene: Callable[[], Scene]) -> None:
    (warning,) = check_scene(make_scene()).warnings
    assert "the base reaches at most 0.6 m² of floor" in warning


def test_invalid_arguments() -> None:
    with pytest.raises(InputError, match="scene"):
        check_scene("drawer")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="seed"):
        check_scene(load_drawer_scene(), seed=-1)


def test_planning_continues_from_the_end_scene() -> None:
    scene = load_drawer_scene()
    held = vkc.plan(scene, [vkc.Grasp("drawer")]).end_scene()
    assert held.held == {"drawer": "handle"}
    after = vkc.plan(held, [vkc.Actuate("drawer", {"slide": 0.3})]).end_scene()
    assert after.objects["drawer"].state[0] == pytest.approx(0.3, abs=1e-3)
    driven = vkc.plan(after, [vkc.Release(), vkc.GoTo(0.0, 0.0)])
    assert driven.end_scene().held == {}
    failed = vkc.plan(scene, [vkc.Actuate("drawer", {"slide": 9.0})])
    with pytest.raises(InputError, match="no success"):
        failed.end_scene()


def load_cup_scene(attachment: str) -> Scene:
    """Return a scene with a cup that has a single attachment."""
    scene = vkc.load_scene("tray")
    (cup,) = (one for one in scene.document["objects"] if one["name"] == "cup")
    return keep_attachment(replace_scene_fields(scene, objects=[cup]), "cup", attachment)


@pytest.mark.parametrize(
    ("attachment", "required", "is_reached"),
    [
        # The closed hand is 5.3 mm from the cup's side, and its fingers 8.0 mm from the rest.
        pytest.param("side", 0.0052, True, marks=pytest.mark.long),
        pytest.param("side", 0.0058, True, marks=pytest.mark.long),
        ("side", 0.0062, True),
        ("side", 0.0065, False),
        ("top", 0.0088, True),
        ("top", 0.0092, False),
        pytest.param("oblique", 0.0088, True, marks=pytest.mark.long),
        pytest.param("oblique", 0.0092, False, marks=pytest.mark.long),
    ],
)
def test_check_and_plan_demand_the_same_clearance(
    attachment: str, required: float, is_reached: bool
) -> None:
    """A clearance that falls short by up to 1 mm is accepted by both, and by neither beyond."""
    scene = load_cup_scene(attachment)
    options = vkc.Options(grasp_clearance=required, reach_waypoints=10)
    (one,) = check_scene(scene, options=options).attachments
    plan = vkc.plan(scene, [vkc.Grasp("cup", attachment)], options=options)
    assert plan.success == is_reached
    assert (one.configuration is not None) == is_reached
    assert ("are only" in one.because) != is_reached
    assert any("are only" in note for note in plan.report.notes) != is_reached
