"""Tests the order of holds, reversed approaches, and measured grasps."""

from __future__ import annotations

import dataclasses
import itertools
import json
import pickle
import shutil
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.drawers import NEAR_HANDLE, load_drawer_scene, make_grasping_scene
from helpers.drives import make_trajectory
from helpers.expected_errors import expect_error
from helpers.small_problems import replace_objects
from hypothesis import given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.world.files.resources import find_resource_folder
from vkc_pin.world.scene.contact_rules import compute_hand_clearance
from vkc_pin.world.scene.hold import check_hold_order, fit_grasp, make_holds

STICK = vkc.Hold("stick", "grip")
BALL = vkc.Hold("ball", "pull", STICK, "tip")
FLY = vkc.Hold("fly", "leg", BALL, "ball")


def test_holds_are_equal_by_object_attachment_and_frame() -> None:
    again = vkc.Hold("ball", "pull", vkc.Hold("stick", "grip", at=(0.1, 2.0)), "tip")
    assert (again, hash(again)) == (BALL, hash(BALL))
    for other in (
        vkc.Hold("ball", "pull"),
        vkc.Hold("ball", "pull", STICK, "stick"),
        vkc.Hold("ball", "pull", vkc.Hold("stick", "end"), "tip"),
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
    for holds in ((BALL,), (BALL, STICK), (STICK, FLY), (vkc.Hold("stick", "end"), BALL)):
        with expect_error("not held before"):
            check_hold_order(holds)


def write_object(path: Path, name: str, old: str, new: str) -> str:
    """Write a modified copy of an object's description; return its path."""
    source = Path(str(find_resource_folder("scenes"))) / "objects"
    shutil.copy(source / f"{name}.urdf", path)
    text = (source / f"{name}.yaml").read_text()
    assert old in text
    (path / f"{name}.yaml").write_text(text.replace(old, new))
    return str(path / f"{name}.yaml")


@pytest.mark.filterwarnings("error")
def test_approach_from_inside_is_reversed(tmp_path: Path) -> None:
    original = load_drawer_scene()
    item = {
        **original.document["objects"][0],
        "type": write_object(tmp_path, "drawer", "approach: [1, 0, 0]", "approach: [-1, 0, 0]"),
    }
    message = r"the hand would approach drawer\.handle(_free)? through the object"
    with pytest.warns(UserWarning, match=message) as caught:
        scene = vkc.Scene.from_document({**original.document, "objects": [item]}, original.folder)
    assert [one.filename for one in caught] == [__file__] * 2
    placed = scene.objects["drawer"]
    assert placed.reversed == ("handle", "handle_free")
    again = vkc.Scene.from_document(scene.document, scene.folder)
    assert again.objects["drawer"].reversed == placed.reversed
    np.testing.assert_array_equal(
        again.objects["drawer"].object.attachment().placement, placed.object.attachment().placement
    )


def make_scene(*objects: dict[str, Any], **fields: Any) -> vkc.Scene:
    document = {"robot": "husky_ur5e", "start": {"base": [0.0, 0.0, 0.0]}, "objects": [*objects]}
    return vkc.Scene.from_document({**document, **fields})


@pytest.mark.filterwarnings("error")
def test_approach_from_below_the_floor_is_reversed(tmp_path: Path) -> None:
    free = "\n    closing: [1, 0, 0]\n    joint: spherical\n    limits: [-1.5, 1.5]"
    file = write_object(
        tmp_path,
        "ball",
        f"approach: [0, 0, -1]{free}",
        "approach: [0, 0, 1]\n    closing: [1, 0, 0]",
    )
    ball = {"name": "ball", "type": file, "position": [1.2, 0.0, 0.036]}
    with pytest.warns(UserWarning, match=r"ball\.grip through the object or the floor"):
        scene = make_scene(ball)
    assert scene.objects["ball"].reversed == ("grip",)
    # Approaches from below are valid there.
    high = make_scene({**ball, "position": [1.2, 0.0, 1.0]})
    for other in (high, make_scene(ball, floor=False), make_scene({**ball, "reversed": []})):
        assert other.objects["ball"].reversed == ()


@pytest.mark.parametrize("name", ["door", "ball", "stick"])
def test_reversing_twice_restores_the_approach(name: str) -> None:
    item = vkc.load_object(name)
    state = np.zeros(item.coordinates.size)
    placed = vkc.PlacedObject(name, item, pin.SE3.Identity(), state)
    for attachment, grasp in item.attachments.items():
        values = [0.3 * freedom.lower + 0.4 * freedom.upper for freedom in grasp.freedoms]
        turned = placed.with_reversed(attachment)
        contact, turned_contact = (
            one.tool(values) * pin.SE3(np.eye(3), np.array([0.0, 0.0, grasp.standoff]))
            for one in (grasp, turned.object.attachment(attachment))
        )
        half_turn = pin.SE3(np.diag([1.0, -1.0, -1.0]), np.zeros(3))  # about the closing direction
        np.testing.assert_allclose(turned_contact, contact * half_turn, atol=1e-12)
        back = turned.with_reversed(attachment)
        again = back.object.attachment(attachment).tool(values)
        np.testing.assert_allclose(again, grasp.tool(values), atol=1e-12)
        assert back.reversed == ()
    with expect_error("there is no attachment"):
        placed.with_reversed("nowhere")


def test_approach_through_a_held_object_is_reversed(tmp_path: Path) -> None:
    joint = "joint: {}\n    standoff: 0.035"
    fixed = write_object(tmp_path, "ball", joint.format("spherical"), joint.format("fixed"))
    first, _, last = Path(fixed).read_text().rpartition("approach: [0, 0, -1]")
    stick = {"name": "stick", "type": "stick", "position": [2.0, 0.0, 0.5]}
    ball = {"name": "ball", "type": fixed, "position": [1.2, 0.0, 0.036]}
    scene = make_scene(stick, ball)
    assert scene.with_approaches([BALL]) is scene
    Path(fixed).write_text(f"{first}approach: [0, 0, 1]{last}")
    with pytest.warns(UserWarning, match=r"would approach ball\.pull"):
        from_below = make_scene(stick, ball).with_approaches([BALL])
    assert from_below.objects["ball"].reversed == ("pull",)


HALL = {
    "robot": "husky_ur5e",
    "start": {"base": [0.0, 0.0, 0.5]},
    "objects": [
        {"name": "drawer", "type": "drawer", "position": [2, 1, 0], "state": {"slide": 0.1}},
        {"name": "cane", "type": "stick", "position": [2, 0, 0.05], "yaw": 0.3},
        {"name": "fruit", "type": "ball", "position": [2, 1, 0.035]},
    ],
}
GRASPS = [("drawer", "handle"), ("drawer", "handle_free"), ("cane", "grip"), ("fruit", "grip")]
unit = st.tuples(*[st.floats(-1.0, 1.0)] * 6).map(np.array)


@cache
def make_hall() -> vkc.Scene:
    return vkc.Scene.from_document(HALL)


def make_measured(name: str, attachment: str, at: list[float], offset: np.ndarray) -> pin.SE3:
    """Return the attachment's pose in a tool frame displaced from the nominal grasp by `offset`."""
    grasp = make_hall().objects[name].object.attachment(attachment)
    return (grasp.motion(at) * pin.SE3(pin.exp3(offset[3:]), offset[:3])).inverse()


def make_measured_scene(
    grasp: tuple[str, str], fraction: float, offset: np.ndarray
) -> tuple[vkc.Scene, pin.SE3]:
    """Return a scene with a grasp displaced in the direction `offset`, and its measured pose."""
    name, attachment = grasp
    at = choose_values(name, attachment, fraction)
    measured = make_measured(*grasp, at, offset * np.repeat([0.011, 0.11], 3))
    scene = make_hall().with_held({name: attachment}, at={name: at}, measured={name: measured})
    return scene, measured


def choose_values(name: str, attachment: str, fraction: float) -> list[float]:
    freedoms = make_hall().objects[name].object.attachment(attachment).freedoms
    return [one.lower + fraction * (one.upper - one.lower) for one in freedoms]


@settings(max_examples=25, deadline=None)
@given(st.sampled_from(GRASPS), st.floats(0.0, 1.0), unit)
def test_virtual_joint_is_the_measured_transform(
    grasp: tuple[str, str], fraction: float, offset: np.ndarray
) -> None:
    (name, attachment), (scene, measured) = grasp, make_measured_scene(grasp, fraction, offset)
    at = scene.holds[0].at
    chain = vkc.consolidate(scene, scene.holds)
    z = np.zeros(chain.size)
    z[: len(scene.start)] = scene.start
    for joint, value in zip(chain.virtual[scene.holds[0]], reversed(at), strict=True):
        z[chain.index(joint)] = value
    placed, data = scene.objects[name], chain.model.createData()
    for joint, value in zip(placed.object.coordinates.names, placed.state, strict=True):
        z[chain.index(f"{name}.{joint}")] = value
    pin.framesForwardKinematics(chain.model, data, chain.coordinates.q(z[None])[0])
    closure = chain.closures[scene.holds[0]]
    base = data.oMi[closure.joint] * closure.local
    nominal = placed.object.attachment(attachment)
    frame = placed.object.link_placement(nominal.link, placed.state) * nominal.placement
    found = scene.tool_placement().actInv(base * frame)
    np.testing.assert_allclose(found, measured, atol=1e-8)
    if placed.object.free:
        np.testing.assert_allclose(placed.placement, base, atol=1e-9)


@settings(max_examples=25, deadline=None)
@given(st.sampled_from(GRASPS), st.floats(0.0, 1.0), unit)
def test_measured_grasp_survives_serialization(
    grasp: tuple[str, str], fraction: float, offset: np.ndarray
) -> None:
    """Covers scenes, trajectories and tables, and holds through the measured one."""
    scene, _ = make_measured_scene(grasp, fraction, offset)
    again = vkc.Scene.from_document(json.loads(json.dumps(scene.document)))
    assert again.holds == scene.holds
    assert again.holds[0].at == scene.holds[0].at
    holds = (*scene.holds, vkc.Hold("fly", "leg", scene.holds[0], "tip"))
    phases = (vkc.PhaseSpan("move", 0, 1, holds),)
    motion = make_trajectory(scene, np.tile(scene.start, (2, 1)), phases=phases)
    with tempfile.TemporaryDirectory() as folder:
        table = vkc.Trajectory.from_csv(motion.to_csv(Path(folder) / "motion.csv"))
    data = vkc.Trajectory.from_dict(json.loads(json.dumps(motion.to_dict())))
    assert table.phases == data.phases == phases


@settings(max_examples=20, deadline=None)
@given(st.floats(0.05, 0.95), unit)
def test_freedoms_are_fitted_to_a_measured_grasp(fraction: float, offset: np.ndarray) -> None:
    name, attachment = "drawer", "handle_free"
    at = choose_values(name, attachment, fraction)
    exact = make_measured(name, attachment, at, np.zeros(6))
    (hold,) = make_hall().with_held({name: attachment}, measured={name: exact}).holds
    assert hold.at == pytest.approx(at, abs=1e-5)
    assert np.abs(hold.deviation or 0.0).max() < 1e-5
    measured = make_measured(name, attachment, at, offset * np.repeat([0.011, 0.11], 3))
    fitted, stated = (
        make_hall().with_held({name: attachment}, at=values, measured={name: measured}).holds[0]
        for values in (None, {name: at})
    )
    scale = np.repeat([0.02, 0.2], 3)
    sizes = [np.linalg.norm(np.divide(one.deviation or 0.0, scale)) for one in (fitted, stated)]
    assert sizes[0] <= sizes[1] + 1e-6


@pytest.mark.parametrize("around", [-3.0, 0.2, 3.0])
def test_freedoms_are_fitted_all_around_a_rim(around: float) -> None:
    rim = vkc.load_object("bowl").attachment("rim")
    values, deviation = fit_grasp(rim, rim.motion([around, 0.1]).inverse(), None, "measured")
    assert values == pytest.approx([around, 0.1], abs=1e-5)
    assert np.abs(deviation or 0.0).max() < 1e-5


@pytest.mark.parametrize(
    ("offset", "got"),
    [
        ([0.0, 0.021, 0.0, 0.0, 0.0, 0.0], "21.0 mm and 0.000 rad"),
        ([0.0, 0.0, 0.0, 0.0, 0.21, 0.0], "0.0 mm and 0.210 rad"),
    ],
)
def test_hand_too_far_from_its_attachment_is_rejected(offset: list[float], got: str) -> None:
    measured = make_measured("drawer", "handle", [], np.array(offset))
    with expect_error(f"held.drawer.measured.*20 mm and 0.2 rad.*{got}"):
        make_hall().with_held({"drawer": "handle"}, measured={"drawer": measured})
    with expect_error(rf"Hold\.deviation.*{got}"):
        vkc.Hold("drawer", "handle", deviation=tuple(offset))


def test_invalid_measured_grasps_are_rejected() -> None:
    assert vkc.Hold("drawer", "handle", deviation=(0.0,) * 6) == vkc.Hold("drawer", "handle")
    with expect_error("wrong number of values"):
        vkc.Hold("drawer", "handle", deviation=(0.0,))
    near = pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.001]))
    with expect_error("held.drawer.measured: a hand that pushes only touches"):
        make_hall().with_held({"drawer": "push"}, measured={"drawer": near})
    with expect_error("drawr", nearest="drawer"):
        make_hall().with_held({"drawer": "handle"}, measured={"drawr": near})


@pytest.mark.parametrize(
    ("measured", "field", "text"),
    [
        ("{position: [0, 0, 0.3]}", "", "300.0 mm and"),
        ("{position: [0, 0]}", ".position", "3 values"),
        ("{position: [0, 0, 0], rol: 1}", ".rol", "position"),
        ("{yaw: 0.1}", ".position", "missing"),
        ("deriv", "", "derive, or a pose"),
        ("derive", "", "mm and"),
    ],
)
def test_errors_in_files_name_the_field(
    tmp_path: Path, measured: str, field: str, text: str
) -> None:
    file = tmp_path / "hall.yaml"
    file.write_text(
        "robot: husky_ur5e\nstart: {base: [0, 0, 0], held: {\n"
        f"  drawer: {{attachment: handle, measured: {measured}}}}}}}\n"
        "objects: [{name: drawer, type: drawer, position: [2, 1, 0]}]\n"
    )
    with expect_error(text, file=file, line=3, field=f"start.held.drawer.measured{field}"):
        vkc.load_scene(file)


def test_grasp_is_derived_from_measured_positions() -> None:
    """Covers one call, several calls, and a file; the arm determines the tool pose."""
    scene, at = load_drawer_scene(), make_grasping_scene().start.copy()
    at[:3] += [0.004, -0.003, 0.002]
    found = scene.with_measured_grasp(
        "drawer", "handle", base=at[:3], arm=at[3:], state={"slide": 0.002}
    )
    placed, grasp = found.objects["drawer"], found.objects["drawer"].object.attachment("handle")
    nominal = placed.link_placement(grasp.link) * grasp.tool()
    offset = nominal.actInv(found.tool_placement())
    np.testing.assert_allclose(found.holds[0].deviation[:3], offset.translation, atol=2e-9)
    np.testing.assert_allclose(found.holds[0].deviation[3:], pin.log3(offset.rotation), atol=2e-9)
    moved = scene.with_start(at[:3], at[3:]).with_state("drawer", {"slide": 0.002})
    document = moved.document
    document["start"]["held"] = {"drawer": {"attachment": "handle", "measured": "derive"}}
    for other in (
        moved.with_measured_grasp("drawer"),
        moved.with_held({"drawer": "handle"}).with_measured_grasp("drawer"),
        vkc.Scene.from_document(document, scene.folder),
    ):
        assert other.holds == found.holds
    with expect_error("too far from the attachment"):
        scene.with_measured_grasp("drawer", base=NEAR_HANDLE[:3])


def test_measured_object_keeps_its_placement_and_holds_others() -> None:
    both = make_hall().with_held({"cane": "grip", "fruit": "pull"}, by={"fruit": "cane.tip"})
    measured = both.objects["cane"].placement * pin.SE3(
        pin.exp3(np.full(3, 0.02)), np.full(3, 0.004)
    )
    found = both.with_measured_grasp("cane", placement=measured)
    assert [str(hold) for hold in found.holds] == [str(hold) for hold in both.holds]
    assert found.holds[1].by == found.holds[0] != both.holds[0]
    found_placement = found.objects["cane"].placement
    np.testing.assert_allclose(found_placement, measured, atol=1e-8)
    tip = [scene.objects["cane"].link_placement("tip") for scene in (both, found)]
    ball = [scene.objects["fruit"].placement for scene in (both, found)]
    np.testing.assert_allclose(tip[0].actInv(ball[0]), tip[1].actInv(ball[1]), atol=1e-8)


def test_hand_clearance_is_at_most_that_of_the_measured_grasp() -> None:
    """The attachment is 20 mm deeper in the drawer; the palm is 10 mm from the bar."""
    scene = make_grasping_scene()
    placed = scene.objects["drawer"]
    handle, deeper = placed.object.attachment("handle"), pin.SE3(np.eye(3), np.array([0, 0, 0.02]))
    handle = dataclasses.replace(handle, placement=handle.placement * deeper)
    item = dataclasses.replace(placed.object, attachments={"handle": handle})
    scene = replace_objects(scene, {"drawer": dataclasses.replace(placed, object=item)})
    found = []
    for depth in (0.0, 0.007, 0.017):
        measured = make_measured("drawer", "handle", [], np.array([0.0, 0.0, depth, 0.0, 0.0, 0.0]))
        measured_scene = scene.with_held({"drawer": "handle"}, measured={"drawer": measured})
        found.append(
            compute_hand_clearance(
                measured_scene, measured_scene.holds[0], "drawer.tray", vkc.Options()
            )
        )
    assert found[0] == vkc.Options().grasp_clearance
    assert found[2] < 0.0 < found[1] < found[0]
    assert found[1] - found[2] == pytest.approx(0.01, abs=1e-6)


def test_name_of_a_held_object_is_in_its_holds() -> None:
    holds = check_hold_order([STICK, BALL])
    assert [name in holds for name in ("stick", "ball", "fly", "grip", "")] == [
        True,
        True,
        False,
        False,
        False,
    ]
    assert (STICK in holds, FLY in holds, None in holds) == (True, False, False)
    assert holds == (STICK, BALL)
    assert hash(holds) == hash((STICK, BALL))
    assert pickle.loads(pickle.dumps(holds)) == holds
    phase = vkc.PhaseSpan("carry", 0, 3, (STICK, BALL))
    assert "ball" in phase.holds
    assert "cup" not in phase.holds
    assert "ball" not in vkc.PhaseSpan("go", 0, 3).holds
    scene = vkc.load_scene("household")
    assert "cup" not in scene.holds
    assert "cup" in scene.with_held({"cup": "side"}).holds
    assert (
        "cup"
        in vkc.Scene.from_document(scene.with_held({"cup": "side"}).document, scene.folder).holds
    )
