"""Tests the order of holds and the reversal of approaches."""

from __future__ import annotations

import itertools
import shutil
import warnings
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.drawers import load_drawer_scene

import vkc_pin as vkc
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.world.files.resources import find_resource_folder
from vkc_pin.world.models.object_file import load_object
from vkc_pin.world.scene.hold import Hold, check_hold_order, make_holds
from vkc_pin.world.scene.scene import Scene

STICK = Hold("stick", "grip")
BALL = Hold("ball", "pull", STICK, "tip")
FLY = Hold("fly", "leg", BALL, "ball")


def test_holds_are_equal_by_object_attachment_and_frame() -> None:
    assert (STICK.frame, BALL.frame) == (None, "stick.tip")
    assert [str(hold) for hold in (STICK, BALL)] == ["stick.grip", "ball.pull by stick.tip"]
    again = Hold("ball", "pull", Hold("stick", "grip", at=(0.1, 2.0)), "tip")
    assert (again, hash(again)) == (BALL, hash(BALL))
    for other in (
        Hold("ball", "pull"),
        Hold("ball", "pull", STICK, "stick"),
        Hold("ball", "pull", Hold("stick", "end"), "tip"),
    ):
        assert other != BALL


@pytest.mark.parametrize("order", list(itertools.permutations(["stick", "ball", "fly"])))
def test_holds_are_ordered_by_dependency(order: tuple[str, ...]) -> None:
    attachments = {"stick": "grip", "ball": "pull", "fly": "leg"}
    found = make_holds(
        {name: attachments[name] for name in order}, {"fly": "ball.ball", "ball": "stick.tip"}
    )
    assert sorted(found, key=str) == sorted([STICK, BALL, FLY], key=str)
    assert found.index(STICK) < found.index(BALL) < found.index(FLY)
    assert check_hold_order(iter(found)) == found
    assert make_holds({}, {}) == ()


def test_a_hold_comes_after_the_one_it_depends_on() -> None:
    for holds in ((BALL,), (BALL, STICK), (STICK, FLY), (Hold("stick", "end"), BALL)):
        with pytest.raises(InputError, match="not held before"):
            check_hold_order(holds)


def write_object(path: Path, name: str, old: str, new: str) -> str:
    """Write a modified copy of an object's description; return its path."""
    source = Path(str(find_resource_folder("scenes"))) / "objects"
    shutil.copy(source / f"{name}.urdf", path)
    text = (source / f"{name}.yaml").read_text()
    assert old in text
    (path / f"{name}.yaml").write_text(text.replace(old, new))
    return str(path / f"{name}.yaml")


def test_approach_from_inside_is_reversed(
    tmp_path: Path,
) -> None:
    original = load_drawer_scene()
    item = {
        **original.document["objects"][0],
        "type": write_object(tmp_path, "drawer", "approach: [1, 0, 0]", "approach: [-1, 0, 0]"),
    }
    with pytest.warns(
        UserWarning, match=r"the hand would approach drawer\.handle through the object"
    ) as caught:
        scene = Scene.from_document({**original.document, "objects": [item]}, original.folder)
    assert sorted(str(one.message).split()[5] for one in caught) == [
        "drawer.handle",
        "drawer.handle_free",
    ]
    assert {one.filename for one in caught} == {__file__}
    placed = scene.objects["drawer"]
    assert placed.reversed == ("handle", "handle_free")
    for name in placed.reversed:
        found, expected = (
            one.objects["drawer"].object.attachment(name) for one in (scene, original)
        )
        np.testing.assert_allclose(
            found.tool(np.zeros(len(found.freedoms))),
            expected.tool(np.zeros(len(expected.freedoms))),
            atol=1e-12,
        )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = Scene.from_document(scene.document, scene.folder)
    assert again.objects["drawer"].reversed == placed.reversed
    np.testing.assert_array_equal(
        again.objects["drawer"].object.attachment().placement, placed.object.attachment().placement
    )


def test_approach_from_below_the_floor_is_reversed(tmp_path: Path) -> None:
    free = "\n    closing: [1, 0, 0]\n    joint: spherical\n    limits: [-1.5, 1.5]"
    file = write_object(
        tmp_path,
        "ball",
        f"approach: [0, 0, -1]{free}",
        "approach: [0, 0, 1]\n    closing: [1, 0, 0]",
    )
    document = {"robot": "husky_ur5e", "start": {"base": [0.0, 0.0, 0.0]}}
    ball = {"name": "ball", "type": file, "position": [1.2, 0.0, 0.036]}
    with pytest.warns(UserWarning, match=r"ball\.grip through the object or the floor"):
        scene = Scene.from_document({**document, "objects": [ball]})
    assert scene.objects["ball"].reversed == ("grip",)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # high above the floor, an approach from below is valid
        high = Scene.from_document({**document, "objects": [{**ball, "position": [1.2, 0.0, 1.0]}]})
        flat = Scene.from_document({**document, "objects": [ball], "floor": False})
        stated = Scene.from_document({**document, "objects": [{**ball, "reversed": []}]})
    assert [one.objects["ball"].reversed for one in (high, flat, stated)] == [()] * 3


@pytest.mark.parametrize("name", ["door", "ball", "stick"])
def test_reversing_twice_restores_the_approach(name: str) -> None:
    item = load_object(name)
    state = np.zeros(item.coordinates.size)
    placed = vkc.PlacedObject(name, item, pin.SE3.Identity(), state)
    for attachment, grasp in item.attachments.items():
        values = [0.3 * freedom.lower + 0.4 * freedom.upper for freedom in grasp.freedoms]
        turned = placed.with_reversed(attachment)
        reversed_tool, tool = turned.object.attachment(attachment).tool(values), grasp.tool(values)
        closing = reversed_tool.rotation[:, 0], tool.rotation[:, 0]
        np.testing.assert_allclose(*closing, atol=1e-12)
        np.testing.assert_allclose(reversed_tool.rotation[:, 2], -tool.rotation[:, 2], atol=1e-12)
        centre = [
            one.translation + grasp.standoff * one.rotation[:, 2] for one in (reversed_tool, tool)
        ]
        np.testing.assert_allclose(*centre, atol=1e-12)
        back = turned.with_reversed(attachment)
        again = back.object.attachment(attachment).tool(values)
        np.testing.assert_allclose(again, tool, atol=1e-12)
        assert back.reversed == ()
    with pytest.raises(UnknownNameError, match="there is no attachment"):
        placed.with_reversed("nowhere")


def test_approach_through_a_held_object_is_reversed(tmp_path: Path) -> None:
    joint = "joint: {}\n    standoff: 0.035"
    fixed = write_object(tmp_path, "ball", joint.format("spherical"), joint.format("fixed"))
    first, _, last = Path(fixed).read_text().rpartition("approach: [0, 0, -1]")
    document = {"robot": "husky_ur5e", "start": {"base": [0.0, 0.0, 0.0]}}
    stick = {"name": "stick", "type": "stick", "position": [2.0, 0.0, 0.5]}
    ball = {"name": "ball", "type": fixed, "position": [1.2, 0.0, 0.036]}
    scene = Scene.from_document({**document, "objects": [stick, ball]})
    hold = Hold("ball", "pull", STICK, "tip")
    assert scene.with_approaches([hold]) is scene
    Path(fixed).write_text(f"{first}approach: [0, 0, 1]{last}")
    with warnings.catch_warnings(record=True) as caught:
        from_below = Scene.from_document({**document, "objects": [stick, ball]})
        from_below = from_below.with_approaches([hold])
    assert "would approach ball.pull" in str(caught[0].message)
    assert from_below.objects["ball"].reversed == ("pull",)
