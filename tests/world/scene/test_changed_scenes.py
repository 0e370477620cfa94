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
import yaml
from helpers.carrying import compute_grasp_pose, describe_box
from helpers.expected_errors import expect_error
from helpers.meshes import write_wedge
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin import GoTo, Scene, load_scene, plan
from vkc_pin.world.scene.clearance_exemptions import find_clearance_exemptions

HALL = """\
robot: husky_ur5e
start: {base: [0.0, 0.0, 0.5], held: HELD}
objects:
  - {name: cane, type: stick, position: [2, 0, 0.05], yaw: 0.3}
  - {name: fruit, type: ball, position: [2, 1, 0.035]}
  - {name: front, type: door, position: [4, 0, 0], yaw: 0.7}
"""
GRIP, BOTH, BY = {"cane": "grip"}, {"cane": "grip", "fruit": "pull"}, {"fruit": "cane.tip"}
angles = st.floats(-np.pi, np.pi)
lengths = st.floats(-2.0, 2.0)


def load_hall(folder: Path, held: str) -> Scene:
    (folder / "hall.yaml").write_text(HALL.replace("HELD", held))
    return load_scene(folder / "hall.yaml")


@cache
def make_hall() -> Scene:
    return Scene.from_document(yaml.safe_load(HALL.replace("HELD", "{}")))


def assert_close(one: pin.SE3, other: pin.SE3, atol: float = 1e-9) -> None:
    np.testing.assert_allclose(one, other, rtol=0.0, atol=atol)


@st.composite
def changed_scenes(draw: st.DrawFn) -> Scene:
    """Return changed copies; poses include a pitch of π/2, where roll and yaw coincide."""
    base = draw(st.none() | st.tuples(lengths, lengths, angles))
    arm = draw(st.none() | st.lists(st.floats(-1.5, 1.5), min_size=6, max_size=6))
    pitch = st.sampled_from([0.0, np.pi / 2]) | angles
    rotation = pin.rpy.rpyToMatrix(*draw(st.tuples(angles, pitch, angles)))
    placement = pin.SE3(rotation, np.array(draw(st.tuples(*[lengths] * 3))))
    held, by = draw(st.sampled_from([({}, {}), (GRIP, {}), (BOTH, {}), (BOTH, BY)]))
    values = draw(st.none() | st.tuples(st.floats(-0.09, 0.09), st.floats(-1.0, 1.0)))
    scene = make_hall().with_start(base=base, arm=arm)
    scene = scene.with_placement(draw(st.sampled_from(list(scene.objects))), placement)
    scene = scene.with_state("front", {"hinge": draw(st.floats(0.0, 1.2))})
    return scene.with_held(held, by=by, at={"cane": values} if held and values else {})


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
    for scene, x in ((moved, 1.0), (make_hall(), 2.0)):
        assert scene.objects["cane"].placement.translation.tolist() == [x, 0.0, 0.05]
    make_hall().document["objects"].clear()
    front = {entry["name"]: entry for entry in moved.document["objects"]}["front"]
    assert front["yaw"] == 0.7, "the description of an unmoved object changed"
    with expect_error("did you mean 'cane'"):
        moved.with_placement("cana", placement)


ROCKS = """\
robot: husky_ur5e
start: {base: [0.0, 0.0, 0.5]}
obstacles:
  - {name: crate, type: box, size: [0.5, 0.4, 0.3], position: [2, 2, 0.15], yaw: 0.2}
  - {name: person, type: cylinder, radius: 0.3, length: 1.8, position: [-2, 2, 0.9]}
  - {name: rock, type: mesh, file: wedge.obj, position: [1, 2, 0], quaternion: [0, 0, 1, 0]}
  - {name: chest, type: urdf, file: chest.urdf, position: [-1, 2, 0], rpy: [0.1, 0.2, 0.3]}
  - {name: chest_0, type: sphere, radius: 0.2, position: [3, 0, 1]}
"""


@pytest.fixture(scope="module")
def rocks(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Return a scene with obstacles of several types; the chest has two shapes."""
    folder = tmp_path_factory.mktemp("rocks")
    write_wedge(folder / "wedge.obj")
    (folder / "chest.urdf").write_text(
        """<robot name="r"><link name="a"><collision><origin xyz="0 0 1"/><geometry>
        <sphere radius="0.1"/></geometry></collision><visual><geometry><sphere radius="0.1"/>
        </geometry></visual></link><link name="b"><collision><geometry><box size="1 2 3"/>
        </geometry></collision><visual><geometry><sphere radius="0.1"/></geometry></visual></link>
        <joint name="j" type="fixed"><parent link="a"/><child link="b"/>
        <origin xyz="0.5 0 0" rpy="0 0 0.4"/></joint></robot>"""
    )
    (folder / "rocks.yaml").write_text(ROCKS)
    return load_scene(folder / "rocks.yaml")


def list_placements(scene: Scene) -> list[pin.SE3]:
    return [shape.placement for shape in (*scene.obstacles, *scene.obstacle_visual)]


@settings(max_examples=25, deadline=None)
@given(
    name=st.sampled_from(["crate", "person", "rock", "chest", "chest_0"]),
    position=st.tuples(lengths, lengths, lengths),
    rpy=st.tuples(angles, st.sampled_from([0.0, np.pi / 2]) | angles, angles),
)
def test_moved_obstacle_takes_its_shapes_along(
    rocks: Scene, name: str, position: tuple[float, ...], rpy: tuple[float, ...]
) -> None:
    placement = pin.SE3(pin.rpy.rpyToMatrix(*rpy), np.array(position))
    moved = rocks.with_obstacle(name, placement)
    entry = {**rocks.document["obstacles"][rocks.obstacle_names.index(name)]}
    for orientation in ("rpy", "yaw", "quaternion"):
        entry.pop(orientation, None)
    entry |= {"position": list(position), "rpy": list(rpy)}
    obstacles = [entry if one["name"] == name else one for one in rocks.document["obstacles"]]
    loaded = Scene.from_document({**rocks.document, "obstacles": obstacles}, rocks.folder)
    for one, other in zip(list_placements(moved), list_placements(loaded), strict=True):
        assert_close(one, other, 1e-12)
    again = Scene.from_document(json.loads(json.dumps(moved.document)), moved.folder)
    assert again.document == moved.document
    for one, other in zip(list_placements(moved), list_placements(again), strict=True):
        assert_close(one, other, 1e-15 if name != "chest" else 1e-12)
    back = moved.with_obstacle(name, pin.SE3.Identity()).with_obstacle(name, placement)
    for one, other in zip(list_placements(back), list_placements(moved), strict=True):
        assert_close(one, other, 1e-12)


def test_moved_obstacle_shares_everything_else(rocks: Scene) -> None:
    moved = rocks.with_obstacle("chest", [0.0, 1.0, 0.5, 0.0, 0.0, 1.0])
    assert moved.robot is rocks.robot
    assert moved.objects is rocks.objects
    assert moved.obstacle_labels == rocks.obstacle_labels
    for one, other, label in zip(
        moved.obstacles, rocks.obstacles, rocks.obstacle_labels, strict=True
    ):
        assert one.geometry == other.geometry
        assert one.name == other.name
        assert (one is other) == (label != "chest")
    # Another obstacle has the name of one of its shapes.
    labels = zip(moved.obstacle_visual, rocks.obstacle_visual, strict=True)
    shared = [one is other for one, other in labels]
    assert shared == [True, True, True, False, False, True]
    assert rocks.document["obstacles"][3]["rpy"] == [0.1, 0.2, 0.3], "the scene itself changed"


def test_exemptions_follow_moved_obstacles() -> None:
    crate = describe_box("crate", [0.3, 0.3, 0.3], [-3.0, 0.0, 0.15])
    scene = Scene.from_document({**make_hall().document, "obstacles": [crate]})
    panel = scene.objects["front"].link_placement("panel")
    near = scene.with_obstacle("crate", panel * pin.SE3(np.eye(3), np.array([0.18, 0.0, 0.0])))
    for one in (scene, near, scene):
        pairs = find_clearance_exemptions(one, 0.2)
        assert any("crate" in (pair.first, pair.second) for pair in pairs) == (one is near)


def test_invalid_moves_of_obstacles_are_refused(rocks: Scene) -> None:
    with expect_error("did you mean 'person'", nearest="person"):
        rocks.with_obstacle("persom", pin.SE3.Identity())
    for name in ("floor", "chest_1"):
        with expect_error(f"there is no obstacle '{name}'"):
            rocks.with_obstacle(name, pin.SE3.Identity())
    with expect_error(field="name"):
        rocks.with_obstacle(3, pin.SE3.Identity())  # type: ignore[arg-type]
    broken = pin.SE3.Identity()
    broken.translation = np.array([0.0, np.nan, 0.0])
    scaled = np.diag([2.0, 2.0, 2.0, 1.0])
    for placement in (broken, scaled, np.full(6, np.inf), [1.0, 2.0, 3.0], [1e9] * 6, "here", None):
        with expect_error(field="placement"):
            rocks.with_obstacle("person", placement)
    twice = {**rocks.document, "obstacles": [rocks.document["obstacles"][0]] * 2}
    with expect_error("already used"):
        Scene.from_document(twice, rocks.folder)


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
    crate = describe_box("crate", [0.02] * 3, held.objects["fruit"].placement.translation.tolist())
    hit = Scene.from_document({**held.document, "obstacles": [crate]})
    assert hit.start_clearance() < 0.0, "held objects are part of the robot"


@pytest.mark.parametrize(
    ("held", "by", "at", "message"),
    [
        ({"cana": "grip"}, {}, {}, "^held: .*did you mean 'cane'"),
        ({"cane": "gripp"}, {}, {}, "did you mean 'grip'"),
        (BOTH, {"fruit": "cana.tip"}, {}, "^by: .*did you mean 'cane'"),
        ({"fruit": "pull"}, BY, {}, "^by: there is no"),
        (BOTH, {"fruit": "cane.tap"}, {}, "did you mean 'tip'"),
        (GRIP, BY, {}, "^by: there is no"),
        (GRIP, {}, {"cana": (0.0, 0.0)}, "^at: .*did you mean 'cane'"),
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
def test_invalid_holds_are_rejected(
    held: Mapping[str, str], by: Mapping[str, str], at: Mapping[str, Any], message: str
) -> None:
    with expect_error(message):
        make_hall().with_held(held, by=by, at=at)


@pytest.mark.parametrize(
    ("held", "message"),
    [
        ("{cane: gripp}", "cane: .*did you mean 'grip'"),
        ("{cana: grip}", "cana: .*did you mean 'cane'"),
        ("{cane: {attachement: grip}}", r"cane\.attachement: .*did you mean 'attachment'"),
        ("{cane: {at: [0.0, 0.0]}}", r"cane\.attachment: .*missing"),
        ("{cane: {attachment: grip, at: [0.2, 0.0]}}", "cane.*outside the joint's"),
        ("{cane: {attachment: grip, at: [0.0, yes]}}", r"cane\.at\[1\]: .*a number"),
        (
            "{cane: {attachment: grip, by: fruit.ball}, fruit: {attachment: pull, by: cane.tip}}",
            ".*in a cycle",
        ),
    ],
)
def test_invalid_holds_are_located_in_files(tmp_path: Path, held: str, message: str) -> None:
    with expect_error(rf"start\.held\.?{message}", file=tmp_path / "hall.yaml", line=2):
        load_hall(tmp_path, held)


# --- allowed overlaps
# ------------------------------------------------------------------------------------------------


def test_allowed_pair_is_kept_in_the_document() -> None:
    scene = make_hall().with_allowed("base_link", "front.panel", -0.002)
    pair = frozenset(("base_link", "front.panel"))
    assert scene.allowed[pair] == -0.002
    assert scene.robot is make_hall().robot
    again = Scene.from_document(scene.document, scene.folder)
    assert again.allowed == scene.allowed
    assert pair not in make_hall().allowed
    # The smallest of several margins counts.
    assert scene.with_allowed("front.panel", "base_link", 0.01).allowed[pair] == -0.002
    assert scene.with_allowed("front.panel", "base_link", -0.01).allowed[pair] == -0.01


def test_allowed_overlap_does_not_block_a_plan() -> None:
    """A box stands 3 mm in the base."""
    document = yaml.safe_load(HALL.replace("HELD", "{}"))
    box = {"name": "crate", "type": "box", "size": [0.4, 0.4, 0.4], "position": [-0.7, 0.0, 0.2]}
    document["start"]["base"] = [0.0, 0.0, 0.0]
    document["obstacles"] = [box]
    scene = Scene.from_document(document)
    box["position"][0] += scene.start_clearance() + 0.003
    scene = Scene.from_document(document)
    assert not plan(scene, [GoTo(0.5, 0.0)]).success
    allowed = scene.with_allowed("base_link", "crate", -0.004)
    found = plan(allowed, [GoTo(0.5, 0.0)])
    assert found.success, found.summary()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("base_lnk", "front.panel", 0.0), "base_link"),
        (("base_link", "front", 0.0), "front"),
        (("base_link", "front.panel", np.nan), "margin"),
    ],
)
def test_wrong_pairs_are_named(arguments: tuple[str, str, float], message: str) -> None:
    with expect_error(message):
        make_hall().with_allowed(*arguments)
