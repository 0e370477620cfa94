"""Tests scenes with held or moved objects, as documents and files, and their errors."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import tool_at

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.world.scene.hold import Hold
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
  - {name: front, type: door, position: [4, 0, 0]}
"""
FETCHING = "{cane: {attachment: grip, at: [0.05, -0.4]}, fruit: {attachment: pull, by: cane.tip, at: [0.3, 0.2, 0.1]}}"


def load(folder: Path, held: str = "{}") -> Scene:
    file = folder / "hall.yaml"
    assert HALL.count("held: {}") == 1
    file.write_text(HALL.replace("held: {}", f"held: {held}"))
    return load_scene(file)


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return load(tmp_path_factory.mktemp("hall"))


def again(scene: Scene) -> Scene:
    """Return the scene that its document describes, by way of JSON."""
    return Scene.from_document(json.loads(json.dumps(scene.document)), scene.folder)


def grips(scene: Scene) -> dict[Hold, tuple[float, ...]]:
    return {hold: hold.at for hold in scene.holds}


def same(first: Scene, second: Scene) -> None:
    """Assert that two scenes are equal in what is where and what is held how."""
    assert grips(first) == grips(second)
    np.testing.assert_array_equal(first.start, second.start)
    for name, placed in first.objects.items():
        np.testing.assert_allclose(
            placed.placement.homogeneous, second.objects[name].placement.homogeneous, atol=1e-9
        )


def assert_same(one: pin.SE3, other: pin.SE3) -> None:
    np.testing.assert_allclose(one.homogeneous, other.homogeneous, atol=1e-9)


# --- elsewhere
# ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "rpy",
    [
        (0.0, 0.0, 0.0),
        (0.3, -0.7, 2.0),
        (0.0, np.pi / 2, 0.4),
        (1.0, -np.pi / 2, 0.0),
        (np.pi, 0.0, 0.0),
        (0.0, 0.0, -np.pi),
    ],
)
def test_object_at_another_placement(hall: Scene, rpy: tuple[float, float, float]) -> None:
    """Upright, lying and standing on its tip, where roll and yaw are one."""
    placement = pin.SE3(pin.rpy.rpyToMatrix(*rpy), np.array([1.0, -2.0, 0.8]))
    moved = hall.with_placement("cane", placement)
    assert moved.objects["cane"].placement == placement
    same(moved, again(moved))
    assert_same(moved.objects["fruit"].placement, hall.objects["fruit"].placement)
    np.testing.assert_array_equal(
        hall.objects["cane"].placement.translation, [2.0, 0.0, 0.05]
    )  # the old one stays as it was
    assert again(hall).document == hall.document


def test_the_scene_keeps_its_own_copy(hall: Scene) -> None:
    placement = pin.SE3(np.eye(3), np.array([1.0, 0.0, 0.05]))
    moved = hall.with_placement("cane", placement)
    placement.translation[:] = 9.0
    np.testing.assert_array_equal(moved.objects["cane"].placement.translation, [1.0, 0.0, 0.05])


def test_fixed_object_at_another_placement(hall: Scene) -> None:
    moved = hall.with_placement(
        "front", pin.SE3(pin.utils.rotate("z", 1.0), np.array([4.0, 1.0, 0.0]))
    )
    np.testing.assert_allclose(
        moved.objects["front"].link_placement("frame").translation, [4.0, 1.0, 0.0]
    )
    same(moved, again(moved))


def test_held_object_is_placed_in_the_hand(hall: Scene) -> None:
    held = hall.with_held({"cane": "end"})
    moved = held.with_placement("cane", pin.SE3.Identity())
    assert_same(moved.objects["cane"].placement, held.objects["cane"].placement)
    same(moved, again(moved))
    let_go = moved.with_held({})  # it stays where the hand left it
    assert_same(let_go.objects["cane"].placement, held.objects["cane"].placement)
    same(let_go, again(let_go))


def test_unknown_object_is_rejected(hall: Scene) -> None:
    with pytest.raises(UnknownNameError) as caught:
        hall.with_placement("cana", pin.SE3.Identity())
    assert caught.value.nearest == "cane"


# --- in the hand
# ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("values", [(0.0, 0.0), (0.05, -0.4), (-0.095, 1.2)])
def test_held_at_some_values_of_the_grasp(hall: Scene, values: tuple[float, float]) -> None:
    held = hall.with_held({"cane": "grip"}, at={"cane": values})
    assert grips(held) == {Hold("cane", "grip"): values}
    for scene in (
        held,
        again(held),
        held.with_start(base=[1.0, 2.0, -2.0]),
        held.with_state("front", {"hinge": 0.5}),
    ):
        expected = scene.tool_placement() * tool_at(pin.SE3.Identity(), values=values).inverse()
        assert_same(scene.objects["cane"].placement, expected)
        assert grips(scene) == {Hold("cane", "grip"): values}
    same(held, again(held))
    if values == (0.0, 0.0):
        assert_same(
            held.objects["cane"].placement,
            hall.with_held({"cane": "grip"}).objects["cane"].placement,
        )
    assert hall.holds == ()


def test_held_through_something(hall: Scene) -> None:
    values, roll = (0.05, -0.4), (0.3, 0.2, 0.1)
    held = hall.with_held(
        {"fruit": "pull", "cane": "grip"},
        by={"fruit": "cane.tip"},
        at={"cane": values, "fruit": roll},
    )
    for scene in (held, again(held), held.with_start(base=[1.0, 2.0, -2.0])):
        cane = scene.tool_placement() * tool_at(pin.SE3.Identity(), values=values).inverse()
        assert_same(scene.objects["cane"].placement, cane)
        tip = scene.objects["cane"].link_placement("tip")
        expected = tip * tool_at(pin.SE3.Identity(), "ball", "pull", roll).inverse()
        assert_same(scene.objects["fruit"].placement, expected)
        touch = tip.translation - scene.objects["fruit"].placement.translation
        assert np.linalg.norm(touch) == pytest.approx(0.035)  # the ball's radius
    same(held, again(held))
    assert [str(hold) for hold in held.holds] == ["cane.grip", "fruit.pull by cane.tip"]


def test_new_holds_replace_old_ones(hall: Scene) -> None:
    held = hall.with_held(
        {"cane": "grip", "fruit": "pull"}, by={"fruit": "cane.tip"}, at={"cane": (0.05, 0.1)}
    )
    other = held.with_held({"cane": "end"})
    assert grips(other) == {Hold("cane", "end"): ()}
    assert other.document["start"]["held"] == {"cane": {"attachment": "end"}}
    same(other, again(other))


def test_files_and_documents_agree(tmp_path: Path, hall: Scene) -> None:
    short = load(tmp_path, "{cane: end}")
    assert short.document["start"]["held"] == {"cane": {"attachment": "end"}}
    same(short, hall.with_held({"cane": "end"}))
    long = load(tmp_path, FETCHING)
    expected = hall.with_held(
        {"cane": "grip", "fruit": "pull"},
        by={"fruit": "cane.tip"},
        at={"cane": (0.05, -0.4), "fruit": (0.3, 0.2, 0.1)},
    )
    same(long, expected)
    assert long.document["start"]["held"] == expected.document["start"]["held"]
    same(long, again(long))
    reversed_order = load(tmp_path, "{fruit: {attachment: pull, by: cane.tip}, cane: grip}")
    same(
        reversed_order, hall.with_held({"cane": "grip", "fruit": "pull"}, by={"fruit": "cane.tip"})
    )


def test_the_start_is_clear_of_what_is_carried_and_samples_carry_it(
    hall: Scene, tmp_path: Path
) -> None:
    text = (
        HALL.replace("held: {}", f"held: {FETCHING}")
        + "start_region: {x: [-1, 1], y: [-1, 1], yaw: any}\n"
    )
    (tmp_path / "hall.yaml").write_text(text)
    scene = load_scene(tmp_path / "hall.yaml").sample_start(np.random.default_rng(0))
    tip = scene.objects["cane"].link_placement("tip").translation
    assert np.linalg.norm(tip - scene.objects["fruit"].placement.translation) == pytest.approx(
        0.035
    )
    here = hall.with_held({"cane": "grip", "fruit": "pull"}, by={"fruit": "cane.tip"})
    ball = here.objects["fruit"].placement.translation
    crate = {"name": "crate", "type": "sphere", "radius": 0.01, "position": ball.tolist()}
    document = {**here.document, "obstacles": [crate]}
    assert Scene.from_document(document).start_clearance() < 0.0


# --- what is wrong
# ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("held", "by", "at", "field", "nearest"),
    [
        ({"cana": "grip"}, {}, {}, "held", "cane"),
        ({"cane": "gripp"}, {}, {}, None, "grip"),
        ({"cane": "grip", "fruit": "pull"}, {"fruit": "cana.tip"}, {}, "by", "cane"),
        ({"fruit": "pull"}, {"fruit": "cane.tip"}, {}, "by", None),  # which is not held
        ({"cane": "grip", "fruit": "pull"}, {"fruit": "cane.tap"}, {}, None, "tip"),
        ({"cane": "grip"}, {"fruit": "cane.tip"}, {}, "by", None),  # as if it were held
        ({"cane": "grip"}, {}, {"cana": (0.0, 0.0)}, "at", "cane"),
    ],
)
def test_unknown_names_are_rejected(
    hall: Scene,
    held: Mapping[str, str],
    by: Mapping[str, str],
    at: Mapping[str, Any],
    field: str | None,
    nearest: str | None,
) -> None:
    with pytest.raises(UnknownNameError) as caught:
        hall.with_held(held, by=by, at=at)
    assert (caught.value.field, caught.value.nearest) == (field, nearest)


@pytest.mark.parametrize(
    ("held", "by", "at", "match"),
    [
        ({"cane": "grip"}, {}, {"cane": (0.0,)}, "wrong number of values"),
        ({"cane": "end"}, {}, {"cane": (0.0,)}, "wrong number of values"),
        ({"cane": "grip"}, {}, {"cane": (0.1, 0.0)}, "outside"),
        ({"cane": "grip"}, {}, {"cane": (0.0, np.nan)}, "not a finite number"),
        ({"cane": "grip", "fruit": "pull"}, {"fruit": "tip"}, {}, "not a link of an object"),
        (
            {"cane": "grip", "fruit": "pull"},
            {"fruit": "cane.tip", "cane": "fruit.ball"},
            {},
            "in a cycle",
        ),
        ({"cane": "grip", "front": "handle"}, {"front": "cane.tip"}, {}, "only a free object"),
        (
            {"fruit": "pull", "front": "handle"},
            {"fruit": "front.lever"},
            {},
            "only through a free one",
        ),
    ],
)
def test_impossible_holds_are_rejected(
    hall: Scene, held: Mapping[str, str], by: Mapping[str, str], at: Mapping[str, Any], match: str
) -> None:
    with pytest.raises(InputError, match=match):
        hall.with_held(held, by=by, at=at)


@pytest.mark.parametrize(
    ("held", "error", "field", "details"),
    [
        ("{cane: gripp}", UnknownNameError, "start.held.cane", "did you mean 'grip'?"),
        ("{cana: grip}", UnknownNameError, "start.held.cana", "did you mean 'cane'?"),
        (
            "{cane: {attachment: gripp}}",
            UnknownNameError,
            "start.held.cane",
            "did you mean 'grip'?",
        ),
        (
            "{cane: {attachement: grip}}",
            UnknownNameError,
            "start.held.cane.attachement",
            "did you mean 'attachment'?",
        ),
        ("{cane: {at: [0.0, 0.0]}}", InputError, "start.held.cane.attachment", "missing"),
        (
            "{cane: {attachment: grip, at: [0.0]}}",
            InputError,
            "start.held.cane",
            "wrong number of values",
        ),
        (
            "{cane: {attachment: grip, at: [0.2, 0.0]}}",
            InputError,
            "start.held.cane",
            "outside the joint's limits",
        ),
        (
            "{cane: {attachment: grip, at: [0.0, .nan]}}",
            InputError,
            "start.held.cane.at[1]",
            "a finite number",
        ),
        (
            "{cane: {attachment: grip, at: [0.0, yes]}}",
            InputError,
            "start.held.cane.at[1]",
            "a number",
        ),
        ("{fruit: {attachment: pull, by: cane.tip}}", UnknownNameError, "start.held.fruit", "cane"),
        (
            "{cane: grip, fruit: {attachment: pull, by: cane.tap}}",
            UnknownNameError,
            "start.held.fruit",
            "did you mean 'tip'?",
        ),
        (
            "{cane: grip, fruit: {attachment: pull, by: tip}}",
            InputError,
            "start.held.fruit",
            "not a link of an object",
        ),
        (
            "{front: handle, fruit: {attachment: pull, by: front.lever}}",
            InputError,
            "start.held.fruit",
            "through a free one",
        ),
        (
            "{cane: {attachment: grip, by: fruit.ball}, fruit: {attachment: pull, by: cane.tip}}",
            InputError,
            "start.held",
            "in a cycle",
        ),
    ],
)
def test_files_with_impossible_holds_are_rejected(
    tmp_path: Path, held: str, error: type[InputError], field: str, details: str
) -> None:
    with pytest.raises(error) as caught:
        load(tmp_path, held)
    assert caught.value.file == tmp_path / "hall.yaml"
    assert caught.value.line == 5
    assert str(caught.value.field).startswith(field), str(caught.value)
    assert details in str(caught.value)
