"""Tests changed copies of scenes: placements, states, holds, and their documents."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import compute_grasp_pose
from helpers.expected_errors import expect_error
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.world.scene.scene import Scene, load_scene

HALL = """\
robot: husky_ur5e
start:
  base: [0.0, 0.0, 0.5]
  arm: home
  held: {}
objects:
  - {name: cane, type: stick, position: [2, 0, 0.05], yaw: 0.3}
  - {name: fruit, type: ball, position: [2, 1, 0.035]}
  - {name: front, type: door, position: [4, 0, 0], yaw: 0.7}
"""
GRIP, BOTH, BY = {"cane": "grip"}, {"cane": "grip", "fruit": "pull"}, {"fruit": "cane.tip"}
angles = st.floats(-np.pi, np.pi)
lengths = st.floats(-2.0, 2.0)


def load_hall(folder: Path, held: str) -> Scene:
    (folder / "hall.yaml").write_text(HALL.replace("held: {}", f"held: {held}"))
    return load_scene(folder / "hall.yaml")


@cache
def make_hall() -> Scene:
    return Scene.from_document(
        {
            "robot": "husky_ur5e",
            "start": {"base": [0.0, 0.0, 0.5]},
            "objects": [
                {"name": "cane", "type": "stick", "position": [2, 0, 0.05], "yaw": 0.3},
                {"name": "fruit", "type": "ball", "position": [2, 1, 0.035]},
                {"name": "front", "type": "door", "position": [4, 0, 0], "yaw": 0.7},
            ],
        }
    )


def assert_close(one: pin.SE3, other: pin.SE3, atol: float = 1e-9) -> None:
    np.testing.assert_allclose(one.homogeneous, other.homogeneous, rtol=0.0, atol=atol)


def change_start(draw: st.DrawFn, scene: Scene) -> Scene:
    arm = draw(st.none() | st.lists(st.floats(-1.5, 1.5), min_size=6, max_size=6))
    return scene.with_start(base=draw(st.none() | st.tuples(lengths, lengths, angles)), arm=arm)


def change_state(draw: st.DrawFn, scene: Scene) -> Scene:
    return scene.with_state("front", {"hinge": draw(st.floats(0.0, 1.2))})


def change_placement(draw: st.DrawFn, scene: Scene) -> Scene:
    """Move an object; poses include a pitch of π/2, where roll and yaw coincide."""
    pitch = st.sampled_from([0.0, np.pi / 2]) | angles
    rotation = pin.rpy.rpyToMatrix(*draw(st.tuples(angles, pitch, angles)))
    name = draw(st.sampled_from(["cane", "fruit", "front"]))
    return scene.with_placement(name, pin.SE3(rotation, np.array(draw(st.tuples(*[lengths] * 3)))))


def change_holds(draw: st.DrawFn, scene: Scene) -> Scene:
    held, by = draw(st.sampled_from([({}, {}), (GRIP, {}), (BOTH, {}), (BOTH, BY)]))
    values = draw(st.none() | st.tuples(st.floats(-0.09, 0.09), st.floats(-1.0, 1.0)))
    return scene.with_held(held, by=by, at={"cane": values} if held and values else {})


@st.composite
def changed_scenes(draw: st.DrawFn) -> Scene:
    scene = make_hall()
    for change in draw(
        st.lists(
            st.sampled_from([change_start, change_state, change_placement, change_holds]),
            max_size=5,
        )
    ):
        scene = change(draw, scene)
    return scene


@settings(max_examples=15, deadline=None)
@given(scene=changed_scenes())
@pytest.mark.long
def test_document_describes_the_changed_scene(scene: Scene) -> None:
    again = Scene.from_document(json.loads(json.dumps(scene.document)), scene.folder)
    assert [(one, one.at) for one in again.holds] == [(one, one.at) for one in scene.holds]
    np.testing.assert_array_equal(again.start, scene.start)
    for name, placed in scene.objects.items():
        np.testing.assert_array_equal(again.objects[name].state, placed.state)
        assert_close(again.objects[name].placement, placed.placement, 1e-12)
    assert again.document == scene.document


def test_documents_and_placements_are_copies() -> None:
    placement = pin.SE3(np.eye(3), np.array([1.0, 0.0, 0.05]))
    moved = make_hall().with_placement("cane", placement)
    placement.translation[:] = 9.0
    np.testing.assert_array_equal(moved.objects["cane"].placement.translation, [1.0, 0.0, 0.05])
    np.testing.assert_array_equal(
        make_hall().objects["cane"].placement.translation, [2.0, 0.0, 0.05]
    )
    make_hall().document["objects"].clear()
    front = {entry["name"]: entry for entry in moved.document["objects"]}["front"]
    assert front["yaw"] == 0.7, "the description of an unmoved object changed"


@pytest.mark.parametrize("values", [(0.0, 0.0), (0.05, -0.4), (-0.095, 1.2)])
def test_held_object_follows_the_hand(values: tuple[float, float]) -> None:
    held = make_hall().with_held(GRIP, at={"cane": values})
    for scene in (
        held,
        held.with_start(base=[1.0, 2.0, -2.0]),
        held.with_placement("cane", pin.SE3.Identity()),
    ):
        grasp = compute_grasp_pose(pin.SE3.Identity(), values=values)
        assert_close(scene.objects["cane"].placement, scene.tool_placement() * grasp.inverse())
    released = held.with_held({})
    assert (released.holds, released.held) == ((), {})
    assert_close(released.objects["cane"].placement, held.objects["cane"].placement)


def test_object_held_through_another_follows_its_link(tmp_path: Path) -> None:
    roll = (0.3, 0.2, 0.1)
    at = {"cane": (0.05, -0.4), "fruit": roll}
    held = make_hall().with_held({"fruit": "pull", "cane": "grip"}, by=BY, at=at)
    assert [str(one) for one in held.holds] == ["cane.grip", "fruit.pull by cane.tip"]
    fruit = "fruit: {attachment: pull, by: cane.tip, at: [0.3, 0.2, 0.1]}"
    file = load_hall(tmp_path, f"{{{fruit}, cane: {{attachment: grip, at: [0.05, -0.4]}}}}")
    for scene in (held, held.with_start(base=[1.0, 2.0, -2.0]), file):
        tip = scene.objects["cane"].link_placement("tip")
        on_tip = compute_grasp_pose(pin.SE3.Identity(), "ball", "pull", roll)
        assert_close(scene.objects["fruit"].placement, tip * on_tip.inverse())
    crate = {
        "name": "crate",
        "type": "sphere",
        "radius": 0.01,
        "position": held.objects["fruit"].placement.translation.tolist(),
    }
    hit = Scene.from_document({**held.document, "obstacles": [crate]})
    assert hit.start_clearance() < 0.0, "held objects are part of the robot"


def test_short_form_of_holds(tmp_path: Path) -> None:
    scene = load_hall(tmp_path, "{cane: end}")
    assert scene.document["start"]["held"] == {"cane": {"attachment": "end"}}
    assert scene.held == make_hall().with_held(GRIP).with_held({"cane": "end"}).held


@pytest.mark.parametrize(
    ("held", "by", "at", "field", "nearest"),
    [
        ({"cana": "grip"}, {}, {}, "held", "cane"),
        ({"cane": "gripp"}, {}, {}, None, "grip"),
        (BOTH, {"fruit": "cana.tip"}, {}, "by", "cane"),
        ({"fruit": "pull"}, BY, {}, "by", None),
        (BOTH, {"fruit": "cane.tap"}, {}, None, "tip"),
        (GRIP, BY, {}, "by", None),
        (GRIP, {}, {"cana": (0.0, 0.0)}, "at", "cane"),
    ],
)
def test_unknown_names_are_rejected(
    held: Mapping[str, str],
    by: Mapping[str, str],
    at: Mapping[str, Any],
    field: str | None,
    nearest: str | None,
) -> None:
    with expect_error(field=field, nearest=nearest):
        make_hall().with_held(held, by=by, at=at)
    with pytest.raises(UnknownNameError, match="did you mean 'cane'"):
        make_hall().with_placement("cana", pin.SE3.Identity())


@pytest.mark.parametrize(
    ("held", "by", "at", "match"),
    [
        (GRIP, {}, {"cane": (0.0,)}, "wrong number of values"),
        ({"cane": "end"}, {}, {"cane": (0.0,)}, "wrong number of values"),
        (GRIP, {}, {"cane": (0.1, 0.0)}, "outside"),
        (GRIP, {}, {"cane": (0.0, np.nan)}, "not a finite number"),
        (BOTH, {"fruit": "tip"}, {}, "not a link of an object"),
        (BOTH, {**BY, "cane": "fruit.ball"}, {}, "in a cycle"),
        ({"cane": "grip", "front": "handle"}, {"front": "cane.tip"}, {}, "only a free object"),
        ({"fruit": "pull", "front": "handle"}, {"fruit": "front.lever"}, {}, "through a free one"),
    ],
)
def test_impossible_holds_are_rejected(
    held: Mapping[str, str], by: Mapping[str, str], at: Mapping[str, Any], match: str
) -> None:
    with expect_error(match):
        make_hall().with_held(held, by=by, at=at)


@pytest.mark.parametrize(
    ("held", "field", "details"),
    [
        ("{cane: gripp}", "start.held.cane", "did you mean 'grip'?"),
        ("{cana: grip}", "start.held.cana", "did you mean 'cane'?"),
        (
            "{cane: {attachement: grip}}",
            "start.held.cane.attachement",
            "did you mean 'attachment'?",
        ),
        ("{cane: {at: [0.0, 0.0]}}", "start.held.cane.attachment", "missing"),
        ("{cane: {attachment: grip, at: [0.2, 0.0]}}", "start.held.cane", "outside the joint's"),
        ("{cane: {attachment: grip, at: [0.0, yes]}}", "start.held.cane.at[1]", "a number"),
        (
            "{cane: {attachment: grip, by: fruit.ball}, fruit: {attachment: pull, by: cane.tip}}",
            "start.held",
            "in a cycle",
        ),
    ],
)
def test_invalid_holds_are_located_in_files(
    tmp_path: Path, held: str, field: str, details: str
) -> None:
    with pytest.raises(InputError, match=details.replace("?", r"\?")) as caught:
        load_hall(tmp_path, held)
    assert (caught.value.file, caught.value.line) == (tmp_path / "hall.yaml", 5)
    assert str(caught.value.field).startswith(field)
