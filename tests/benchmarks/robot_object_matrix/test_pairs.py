"""Tests the scenes of the robot–object matrix: a robot and an articulated object in a hall."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vkc_pin as vkc
from vkc_pin.benchmarks.robot_object_matrix.pairs import (
    SHARE,
    load_description,
    make_hall,
    make_pair,
)
from vkc_pin.world.files.resources import find_resource_folder
from vkc_pin.world.models.shapes import compute_world_box
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import START_CLEARANCE

SMOOTH = """<robot name="smooth"><link name="frame"/>
<link name="block"><collision><geometry><box size="0.4 0.4 0.4"/></geometry></collision></link>
<joint name="slide" type="prismatic">
<parent link="frame"/><child link="block"/><origin xyz="0 0 0.5"/><axis xyz="-1 0 0"/>
<limit lower="0" upper="0.3" effort="1" velocity="1"/></joint></robot>"""

# No hand can grasp this ball or turn it by pushing.
SPHERE = """<robot name="smooth"><link name="frame"/>
<link name="ball"><collision><geometry><sphere radius="0.2"/></geometry></collision></link>
<joint name="spin" type="revolute">
<parent link="frame"/><child link="ball"/><origin xyz="0 0 0.5"/><axis xyz="0 0 1"/>
<limit lower="0" upper="1" effort="1" velocity="1"/></joint></robot>"""


@pytest.fixture(scope="module")
def husky() -> vkc.Robot:
    return vkc.load_robot("husky_ur5e")


def test_description_does_not_depend_on_its_source() -> None:
    stored = find_resource_folder("scenes") / "objects" / "narrow_door.yaml"
    by_name, by_path = load_description("narrow_door"), load_description(str(stored))
    assert by_name == by_path
    assert Path(by_name["urdf"]).is_absolute()
    assert vkc.load_object(by_name).name == "narrow_door"
    assert load_description("oven_7") == vkc.procedural.random_object("oven", 7)
    with pytest.raises(vkc.UnknownNameError, match="did you mean 'oven_0'"):
        load_description("ofen_0")


@pytest.mark.parametrize("name", ["drawers_0", "faucet_0", "narrow_door", "low_drawer"])
def test_objects_are_placed_by_kind(name: str) -> None:
    scene = make_hall("husky_ur5e", name, load_description(name))
    boxes = np.array(
        [
            compute_world_box(shape.geometry, shape.placement)
            for shape in make_world_shapes(scene.objects["it"])
        ]
    )
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    counters = [label for label in scene.obstacle_names if "worktop" in label]
    assert bool(counters) == (name == "faucet_0")
    assert (low[2] > 0.7) if counters else (0.0 <= low[2] < 0.05)
    in_wall = name == "narrow_door"
    assert (high[0] > 4.0) == in_wall, (
        "a door is in the wall at x = 4 m, other objects are in front of it"
    )
    assert scene.arena[1] == (6.0 if in_wall else 4.0), "the floor extends beyond a door"
    assert low[0] > 2.9, "the robot starts 2 m away"
    start = scene.sample_start(np.random.default_rng(0))
    assert start.start_clearance() >= START_CLEARANCE
    assert not np.array_equal(start.start, scene.start)


def test_joint_is_opened_by_half_its_range(husky: vkc.Robot) -> None:
    pair = make_pair(husky, "husky_ur5e", "drawers_0")
    assert pair.scene is not None
    assert pair.step is not None
    item = pair.scene.objects["it"].object
    proposals = vkc.importing.propose_attachments(
        vkc.load_object(vkc.procedural.random_object("drawers", 0)), husky
    )
    ((joint, goal),) = pair.step.joints.items()
    assert pair.step.attachment is None, "the planner chooses the attachment"
    assert goal == pytest.approx(
        SHARE * (item.upper - item.lower)[item.coordinates.index(joint)], abs=1e-3
    )
    opening = {
        proposal.attachment.name: proposal.opens[joint] for proposal in proposals.opening(joint)
    }
    assert list(item.attachments) == [name for name, value in opening.items() if value >= goal]


@pytest.mark.parametrize(("height", "raised"), [(0.4, True), (0.8, False)])
def test_low_objects_are_placed_on_a_counter(tmp_path: Path, height: float, raised: bool) -> None:
    urdf = SMOOTH.replace("0.4 0.4 0.4", f"0.4 0.4 {height}").replace(
        "0 0 0.5", f"0 0 {height / 2}"
    )
    file = _write_object(tmp_path / "box.yaml", urdf=urdf)
    scene = make_hall("husky_ur5e", file, load_description(file))
    boxes = np.array(
        [
            compute_world_box(shape.geometry, shape.placement)
            for shape in make_world_shapes(scene.objects["it"])
        ]
    )
    counters = [label for label in scene.obstacle_names if "worktop" in label]
    assert bool(counters) == raised
    assert boxes[:, 0].min(axis=0)[2] == pytest.approx(0.801 if raised else 0.0, abs=1e-6)
    assert not [pair for pair in vkc.check_scene(scene).close if pair.distance < 0.0]


def _write_object(path: Path, **fields: Any) -> str:
    description: Mapping[str, Any] = {"urdf": SMOOTH, "attachments": [], **fields}
    return str(vkc.procedural.write_object(description, path))


def test_object_without_a_grasp_is_unreachable(husky: vkc.Robot, tmp_path: Path) -> None:
    pair = make_pair(husky, "husky_ur5e", _write_object(tmp_path / "smooth.yaml", urdf=SPHERE))
    assert pair.step is None
    assert pair.because.startswith("spin: nothing of it fits between the fingers")


def test_robot_without_a_hand_has_no_step() -> None:
    pair = make_pair(vkc.load_robot("ur5"), "ur5", "drawers_0")
    assert (pair.scene, pair.step) == (None, None)
    assert "the hand of 'ur5_robot' is undefined" in pair.because


def test_high_object_is_unreachable(husky: vkc.Robot, tmp_path: Path) -> None:
    foot = (
        '<link name="frame"><collision><origin xyz="0 0 0.1"/>'
        '<geometry><box size="0.2 0.2 0.2"/></geometry></collision></link>'
    )
    bar = (
        '<link name="bar"><collision><geometry><box size="0.02 0.2 0.02"/></geometry></collision>'
        "</link>"
    )
    fixed = (
        '<joint name="on" type="fixed"><parent link="block"/><child link="bar"/>'
        '<origin xyz="-0.26 0 0"/></joint>'
    )
    high = SMOOTH.replace("0 0 0.5", "0 0 3.5").replace('<link name="frame"/>', foot)
    pair = make_pair(
        husky,
        "husky_ur5e",
        _write_object(
            tmp_path / "high.yaml", urdf=high.replace("</robot>", f"{bar}{fixed}</robot>")
        ),
    )
    assert pair.step is None
    assert pair.because.startswith("bar_bar: ")
