"""Articulated objects: reading them, and re-rooting them at any link."""

from __future__ import annotations

import dataclasses
import itertools
import re
import tempfile
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vkc_pin.chain.inversion import invert
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.files.urdf import load_urdf
from vkc_pin.models.articulation import DEFAULT_ACCELERATION, DEFAULT_VELOCITY, ArticulatedObject
from vkc_pin.models.object_file import load_object
from vkc_pin.models.shapes import clearance, placed_shapes
from vkc_pin.scene.placed import PlacedObject, standing_geometry

KINDS = ("revolute", "continuous", "prismatic", "fixed")
AXES = ("1 0 0", "0 1 0", "0 0 1", "-1 0 0", "0 0 -1", "0.6 0 0.8", "1 -2 3")
SHAPES = ('<box size="0.1 0.2 0.3"/>', '<sphere radius="0.1"/>', '<cylinder radius="0.1" length="0.4"/>')


def joint(name: str, kind: str, parent: str, child: str, axis: str) -> str:
    limit = '<limit lower="-1" upper="1" velocity="1" effort="1"/>'
    links = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{links}<axis xyz="{axis}"/>{limit}</joint>'


@st.composite
def trees(draw: st.DrawFn) -> tuple[str, int]:
    """Random URDF trees of 1 to 8 links, and the index of one of the links."""
    number = draw(st.integers(1, 8))
    length = st.floats(-1.0, 1.0).map(lambda x: round(x, 4))
    parts = []
    for i in range(number):
        origin = (
            f'<origin xyz="{draw(length)} {draw(length)} {draw(length)}" rpy="{draw(length)} {draw(length)} {draw(length)}"/>'
        )
        shape = f"{origin}<geometry>{draw(st.sampled_from(SHAPES))}</geometry>"
        inertia = '<mass value="1.5"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
        bodies = f"<inertial>{origin}{inertia}</inertial><collision>{shape}</collision><visual>{shape}</visual>"
        parts.append(f'<link name="l{i}">{bodies}</link>')
    for i in range(1, number):
        origin = (
            f'<origin xyz="{draw(length)} {draw(length)} {draw(length)}" rpy="{draw(length)} {draw(length)} {draw(length)}"/>'
        )
        parent, kind, axis = draw(st.integers(0, i - 1)), draw(st.sampled_from(KINDS)), draw(st.sampled_from(AXES))
        limit = f'<limit lower="-2" upper="{1 + i}" velocity="{i}" effort="{10 * i}"/>'
        links = f'<parent link="l{parent}"/><child link="l{i}"/>'
        parts.append(f'<joint name="j{i}" type="{kind}">{links}{origin}<axis xyz="{axis}"/>{limit}</joint>')
    return f'<robot name="t">{"".join(parts)}</robot>', draw(st.integers(0, number - 1))


def load_text(urdf: str, yaml: str) -> ArticulatedObject:
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "thing.urdf").write_text(urdf)
        (Path(folder) / "thing.yaml").write_text(yaml)
        return load_object(Path(folder) / "thing.yaml")


def placements(model: pin.Model, geometry: pin.GeometryModel, q: np.ndarray) -> tuple[dict[str, pin.SE3], dict[str, pin.SE3]]:
    """Placements in the universe frame of all body frames and of all shapes, by name."""
    data, shapes = model.createData(), geometry.createData()
    pin.framesForwardKinematics(model, data, q)
    pin.updateGeometryPlacements(model, data, geometry, shapes)
    bodies = {frame.name: data.oMf[i].copy() for i, frame in enumerate(model.frames) if frame.type == pin.FrameType.BODY}
    return bodies, {shape.name: shapes.oMg[i].copy() for i, shape in enumerate(geometry.geometryObjects)}


@settings(max_examples=120, deadline=None)
@given(trees(), st.integers(0, 2**32 - 1))
def test_every_frame_and_shape_of_the_inverted_tree_is_where_it_was(tree: tuple[str, int], seed: int) -> None:
    urdf, root = tree
    thing = load_text(urdf, "urdf: thing.urdf\nattachments: [{name: a, link: l0}]")
    link, z = f"l{root}", np.random.default_rng(seed).uniform(-3.0, 3.0, thing.coordinates.size)
    inverted = invert(thing, link, z)
    moving = inverted.coordinates.names
    assert set(moving) <= set(thing.coordinates.names)
    q = inverted.coordinates.q(np.array([z[thing.coordinates.index(name)] for name in moving]))
    for old_geometry, new_geometry in ((thing.collision, inverted.collision), (thing.visual, inverted.visual)):
        bodies, shapes = placements(thing.model, old_geometry, thing.coordinates.q(z))
        new_bodies, new_shapes = placements(inverted.model, new_geometry, q)
        assert new_bodies.keys() == bodies.keys()
        assert new_shapes.keys() == shapes.keys()
        to_root = bodies[link].inverse()
        for old, new in ((bodies, new_bodies), (shapes, new_shapes)):
            for name in old:
                np.testing.assert_allclose(new[name].homogeneous, (to_root * old[name]).homogeneous, atol=1e-12, rtol=0.0)
    for name in moving:
        old, new = thing.coordinates.index(name), inverted.coordinates.index(name)
        for attribute in ("lower", "upper", "velocity"):
            assert getattr(inverted.coordinates, attribute)[new] == getattr(thing.coordinates, attribute)[old]
    assert sum(i.mass for i in inverted.model.inertias) == pytest.approx(sum(i.mass for i in thing.model.inertias))
    for shape in inverted.collision.geometryObjects:
        frame = inverted.model.frames[shape.parentFrame]
        assert frame.parentJoint == shape.parentJoint
        assert shape.name.startswith(frame.name)


def test_only_the_path_to_the_base_moves_and_side_branches_keep_their_state() -> None:
    links = "".join(f'<link name="{name}"/>' for name in ("base", "arm", "hand", "side", "back"))
    joints = (
        joint("shoulder", "revolute", "base", "arm", "0 0 1")
        + joint("wrist", "prismatic", "arm", "hand", "1 0 0")
        + joint("flap", "revolute", "arm", "side", "0 1 0")
        + joint("lid", "revolute", "base", "back", "1 0 0")
    )
    urdf = f'<robot name="t">{links}{joints}</robot>'
    thing = load_text(urdf, "urdf: thing.urdf\nattachments: [{name: a, link: hand}]")
    state = dict(zip(thing.coordinates.names, [0.0] * 4, strict=True)) | {"flap": 0.4, "lid": -0.3}
    inverted = invert(thing, "hand", np.array([state[name] for name in thing.coordinates.names]))
    assert inverted.coordinates.names == ("wrist", "shoulder")
    bodies, _ = placements(inverted.model, inverted.collision, inverted.coordinates.q([0.7, 0.2]))
    np.testing.assert_allclose(bodies["arm"].actInv(bodies["side"]).rotation, pin.utils.rotate("y", 0.4), atol=1e-12)
    np.testing.assert_allclose(bodies["base"].actInv(bodies["back"]).rotation, pin.utils.rotate("x", -0.3), atol=1e-12)
    np.testing.assert_allclose(bodies["arm"].translation, [-0.7, 0.0, 0.0], atol=1e-12)
    assert invert(thing, "base", [0.0] * 4).model.nq == 0


def test_inverting_aligned_joints_leaves_exact_zeros_and_ones() -> None:
    inverted = invert(load_object("door"), "lever", [0.0, 0.0])
    for placement in inverted.model.jointPlacements:
        assert set(np.abs(placement.rotation).ravel()) <= {0.0, 1.0}
    assert [joint.shortname() for joint in inverted.model.joints][1:] == ["JointModelRZ", "JointModelRZ"]


def test_invert_refuses_unknown_links_and_wrong_states() -> None:
    door = load_object("door")
    with pytest.raises(UnknownNameError) as caught:
        invert(door, "levr", [0.0, 0.0])
    assert caught.value.nearest == "lever"
    with pytest.raises(InputError, match="number of coordinates"):
        invert(door, "lever", [0.0])


def test_door() -> None:
    door = load_object("door")
    assert door.coordinates.names == ("hinge", "knob")
    assert (door.base_link, door.links) == ("frame", ("frame", "panel", "lever"))
    assert not door.free
    np.testing.assert_array_equal(door.lower, [-1.57, 0.0])
    np.testing.assert_array_equal(door.upper, [1.57, 0.8])
    np.testing.assert_array_equal(door.velocity, [1.0, 2.0])
    np.testing.assert_array_equal(door.acceleration, [1.0, 4.0])
    (latch,) = door.latches
    assert (latch.joint, latch.held_at, latch.released_by, latch.threshold, latch.engaged_within) == (
        "hinge",
        0.0,
        "knob",
        0.5,
        0.05,
    )
    assert list(door.attachments) == ["handle", "handle_free"]
    assert door.attachment() is door.attachment("handle")
    free = door.attachment("handle_free")
    (tilt,) = free.freedoms
    assert (free.joint, free.coordinates, tilt.kind, tilt.lower, tilt.upper) == (
        "revolute",
        ("handle_free",),
        "revolute",
        -0.6,
        0.6,
    )
    np.testing.assert_array_equal(tilt.axis, [0.0, 1.0, 0.0])
    assert (free.standoff, free.firm) == (0.0, False)
    with pytest.raises(UnknownNameError) as caught:
        door.attachment("handel")
    assert caught.value.nearest == "handle"


def test_the_door_moves_as_its_description_says() -> None:
    door = load_object("door")
    closed, pushed = (door.link_placement("lever", [hinge, 0.0]).translation for hinge in (0.0, 1.0))
    assert pushed[0] > closed[0] + 0.5, "hinge > 0 pushes the panel away from the handle's side, towards +x"
    level, turned = (door.link_placement("lever", [0.0, knob]) * door.attachment().placement for knob in (0.0, 0.5))
    assert turned.translation[2] < level.translation[2] - 0.02, "knob > 0 turns the lever's end down"
    np.testing.assert_allclose(level.rotation[:, 2], [1.0, 0.0, 0.0], atol=1e-12)  # the tool approaches along +x
    np.testing.assert_allclose(level.rotation[:, 0], [0.0, 0.0, 1.0], atol=1e-12)  # and closes across the bar
    assert 0.95 <= level.translation[2] <= 1.0
    assert -0.125 - 0.02 <= level.translation[0] <= -0.07 - 0.02, "the bar stands in front of the panel's face at -0.02"


def test_drawer() -> None:
    drawer = load_object("drawer")
    assert drawer.coordinates.names == ("slide",)
    assert (drawer.lower[0], drawer.upper[0], drawer.velocity[0], drawer.acceleration[0]) == (0.0, 0.4, 0.5, 1.0)
    assert drawer.latches == ()
    assert list(drawer.attachments) == ["handle", "handle_free"]
    moved = drawer.link_placement("tray", [0.4]).translation - drawer.link_placement("tray", [0.0]).translation
    np.testing.assert_allclose(moved, [-0.4, 0.0, 0.0], atol=1e-12)  # out of the cabinet, towards whoever pulls


@pytest.mark.parametrize(("name", "steps"), [("door", (158, 3)), ("drawer", (41,))])
def test_moving_parts_keep_away_from_the_base_over_the_whole_range(name: str, steps: tuple[int, ...]) -> None:
    thing = load_object(name)
    still = [s for s in thing.collision.geometryObjects if s.parentJoint == 0]
    assert len(still) >= 3
    grids = [np.linspace(*limits, n) for *limits, n in zip(thing.lower, thing.upper, steps, strict=True)]
    nearest = np.inf
    for state in itertools.product(*grids):
        placed = standing_geometry(PlacedObject(name, thing, pin.SE3.Identity(), np.array(state)))
        moving = [s for s, original in zip(placed, thing.collision.geometryObjects, strict=True) if original.parentJoint != 0]
        nearest = min(nearest, clearance(placed_shapes(moving), placed_shapes(still)))
    assert 0.02 < nearest < 0.05


SLIDE = "    axis: [0, 1, 0]\n    limits: [-0.1, 0.2]"
BASE = """urdf: thing.urdf
joints:
  hinge: {acceleration: 3}
attachments:
  - name: grip
    link: panel
latches:
  - {joint: hinge, released_by: knob, threshold: 0.5, engaged_within: 0.05}
"""
URDF = (
    '<robot name="t"><link name="frame"/><link name="panel"/><link name="lever"/>'
    + joint("hinge", "revolute", "frame", "panel", "0 0 1")
    + '<joint name="knob" type="continuous"><parent link="panel"/><child link="lever"/><axis xyz="1 0 0"/></joint></robot>'
)


def test_limits_that_are_not_stated_have_documented_defaults() -> None:
    thing = load_text(URDF, BASE)
    np.testing.assert_array_equal(thing.velocity, [1.0, DEFAULT_VELOCITY])
    np.testing.assert_array_equal(thing.acceleration, [3.0, DEFAULT_ACCELERATION])


GRASPS = [
    ("fixed", "", ()),
    ("revolute", "axis: [1, 2, -2], limits: [-0.4, 0.5]", ("",)),
    ("prismatic", "axis: [1, 2, -2], limits: [-0.4, 0.5]", ("",)),
    ("cylindrical", "axis: [1, 2, -2], limits: [-0.4, 0.5], turn: [-1.2, 1.1]", ("_slide", "_turn")),
    ("spherical", "", ("_x", "_y", "_z")),
    ("spherical", "limits: [-0.4, 0.5]", ("_x", "_y", "_z")),
]


@pytest.mark.parametrize(("joint", "fields", "suffixes"), GRASPS)
@pytest.mark.parametrize("standoff", [0.0, 0.07])
def test_an_attachment_moves_as_its_joint_does(joint: str, fields: str, suffixes: tuple[str, ...], standoff: float) -> None:
    entry = ", ".join(part for part in (f"name: grip, link: panel, joint: {joint}, standoff: {standoff}", fields) if part)
    grip = load_text(URDF, f"urdf: thing.urdf\nattachments: [{{{entry}}}]").attachment()
    placement = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.2, 1.0), np.array([0.1, 0.2, -0.3]))
    grip = dataclasses.replace(grip, placement=placement)
    assert (grip.joint, grip.standoff) == (joint, standoff)
    assert grip.coordinates == tuple(f"grip{suffix}" for suffix in suffixes)
    stated = {"_turn": (-1.2, 1.1)} if joint == "cylindrical" else {}
    usual = (-0.4, 0.5) if "limits" in fields else (-np.pi, np.pi)
    assert [(f.lower, f.upper) for f in grip.freedoms] == [stated.get(suffix, usual) for suffix in suffixes]
    v, axis = np.random.default_rng(0).uniform(-1.0, 1.0, len(suffixes)), np.array([1.0, 2.0, -2.0]) / 3.0
    turn, centre = Rotation.identity(), np.zeros(3)
    if joint == "spherical":
        turn = Rotation.from_euler("XYZ", v)
    elif joint != "fixed":
        turn = Rotation.from_rotvec(axis * (v[-1] if joint != "prismatic" else 0.0))
        centre = axis * (v[0] if joint != "revolute" else 0.0)
    moved = grip.motion(v)
    np.testing.assert_allclose(moved.rotation, turn.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(moved.translation, centre + turn.apply([0.0, 0.0, -standoff]), atol=1e-12)
    np.testing.assert_allclose(grip.tool(v).homogeneous, placement.homogeneous @ moved.homogeneous, atol=1e-12)
    with pytest.raises(InputError, match="one a freedom"):
        grip.motion([*v, 0.0])


@pytest.mark.parametrize(("free", "stated", "firm"), [(0, "", 0), (1, "", 1), (0, "firm: true", 1), (1, "firm: false", 0)])
def test_a_hand_clamps_what_is_free_unless_told_otherwise(free: int, stated: str, firm: int) -> None:
    text = f"urdf: thing.urdf\nfree: {bool(free)}\nattachments: [{{name: grip, link: panel, {stated}}}]"
    assert load_text(URDF, text).attachment().firm is bool(firm)


def test_two_grasps_cannot_share_a_coordinate() -> None:
    slide = "name: grip_slide, link: panel, joint: prismatic, axis: [1, 0, 0], limits: [0, 1]"
    both = f"{{name: grip, link: panel, joint: cylindrical, axis: [1, 0, 0], limits: [0, 1], turn: [0, 1]}}, {{{slide}}}"
    with pytest.raises(InputError, match="grip_slide") as caught:
        load_text(URDF, f"urdf: thing.urdf\nattachments: [{both}]")
    assert caught.value.field == "attachments[1].name"


@pytest.mark.parametrize(
    ("old", "new", "line", "field", "nearest"),
    [
        ("acceleration", "aceleration", 3, "joints.hinge.aceleration", "acceleration"),
        ("  hinge:", "  hingge:", 3, "joints.hingge", "hinge"),
        ("link: panel", "link: panell", 6, "attachments[0].link", "panel"),
        ("joint: hinge", "joint: hinges", 8, "latches[0].joint", "hinge"),
        ("released_by: knob", "released_by: knot", 8, "latches[0].released_by", "knob"),
        ("link: panel", "link: panel\n    joint: revolut", 7, "attachments[0].joint", "revolute"),
        ("latches:", "latch:", 7, "latch", "latches"),
    ],
)
def test_unknown_names_in_a_description(old: str, new: str, line: int, field: str, nearest: str) -> None:
    with pytest.raises(UnknownNameError) as caught:
        load_text(URDF, BASE.replace(old, new))
    assert (caught.value.line, caught.value.field, caught.value.nearest) == (line, field, nearest)
    assert Path(str(caught.value.file)).name == "thing.yaml"
    assert f"did you mean '{nearest}'" in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "line", "field"),
    [
        ("acceleration: 3", "acceleration: -3", 3, "joints.hinge.acceleration"),
        ("acceleration: 3", "acceleration: .nan", 3, "joints.hinge.acceleration"),
        ("acceleration: 3", "acceleration: yes", 3, "joints.hinge.acceleration"),
        ("link: panel", "position: [0, 0, 0]", 5, "attachments[0].link"),
        ("link: panel", "link: panel\n    joint: revolute", 5, "attachments[0]"),
        ("link: panel", "link: panel\n    joint: revolute\n    axis: [0, 0, 0]", 8, "attachments[0].axis"),
        (
            "link: panel",
            "link: panel\n    joint: revolute\n    axis: [0, 0, 1]\n    limits: [0.1, 1]",
            9,
            "attachments[0].limits",
        ),
        ("link: panel", "link: panel\n    joint: spherical\n    axis: [0, 0, 1]", 5, "attachments[0]"),
        ("link: panel", "link: panel\n    joint: spherical\n    limits: [0.1, 1]", 8, "attachments[0].limits"),
        ("link: panel", f"link: panel\n    joint: cylindrical\n{SLIDE}", 5, "attachments[0]"),
        ("link: panel", f"link: panel\n    joint: cylindrical\n{SLIDE}\n    turn: [1, 2]", 10, "attachments[0].turn"),
        ("link: panel", f"link: panel\n    joint: cylindrical\n{SLIDE}\n    turn: 1.2", 10, "attachments[0].turn"),
        ("link: panel", "link: panel\n    joint: cylindrical\n    axis: [0, 1, 0]\n    turn: [-1, 1]", 5, "attachments[0]"),
        ("link: panel", "link: panel\n    joint: cylindrical\n    limits: [-1, 1]\n    turn: [-1, 1]", 5, "attachments[0]"),
        ("link: panel", f"link: panel\n    joint: revolute\n{SLIDE}\n    turn: [-1, 1]", 5, "attachments[0]"),
        ("link: panel", "link: panel\n    turn: [-1, 1]", 5, "attachments[0]"),
        ("link: panel", "link: panel\n    standoff: -0.01", 7, "attachments[0].standoff"),
        ("link: panel", "link: panel\n    firm: 2", 7, "attachments[0].firm"),
        ("link: panel", "link: panel\n    approach: [1, 0, 0]", 5, "attachments[0]"),
        ("link: panel", "link: panel\n    approach: [1, 0, 0]\n    closing: [1, 0, 1]", 5, "attachments[0]"),
        ("link: panel", "link: panel\n  - name: grip\n    link: panel", 7, "attachments[1].name"),
        ("joint: hinge,", "joint: hinge, held_at: 2,", 8, "latches[0].held_at"),
        ("released_by: knob", "released_by: hinge", 8, "latches[0].released_by"),
        ("engaged_within: 0.05", "engaged_within: 0", 8, "latches[0].engaged_within"),
        ("latches:", "urdf: thing.urdf\nlatches:", 7, "urdf"),
        ("link: panel", "link: [panel", 7, None),
    ],
)
def test_wrong_values_in_a_description(old: str, new: str, line: int, field: str | None) -> None:
    with pytest.raises(InputError) as caught:
        load_text(URDF, BASE.replace(old, new))
    assert (caught.value.line, caught.value.field) == (line, field), str(caught.value)
    assert Path(str(caught.value.file)).name == "thing.yaml"


@pytest.mark.parametrize(
    ("urdf", "message"),
    [
        (URDF.replace("</robot>", ""), "not valid XML"),
        (URDF.replace("robot", "model"), "expected an element <robot>"),
        (URDF.replace('type="continuous"', 'type="floating"'), "knob: this joint type is not supported"),
        (URDF.replace('<axis xyz="1 0 0"/>', '<axis xyz="1 0 0"/><mimic joint="hinge"/>'), "knob: joints that mimic"),
        (URDF.replace('velocity="1"', 'velocity="0"'), "hinge.limit.velocity"),
        (URDF.replace('child link="lever"', 'child link="lver"'), "not a valid URDF"),
        (
            URDF.replace('<link name="panel"/>', f'<link name="panel"><visual><geometry>{SHAPES[0]}</geometry></visual></link>'),
            "nothing in this URDF can collide",
        ),
    ],
)
def test_wrong_urdfs_are_refused(urdf: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        load_text(urdf, BASE)
    assert message in str(caught.value)
    assert Path(str(caught.value.file)).name == "thing.urdf"


@pytest.mark.parametrize(
    ("shape", "problem"),
    [
        ('<box size="nan 5.8 2"/>', "3 numbers"),
        ('<box size="1 2"/>', "3 numbers"),
        ('<box size="1,5 2 3"/>', "3 numbers"),
        ("<box/>", "3 numbers"),
        ('<box size="1 -2 3"/>', "sizes above 0"),
        ('<sphere radius="0"/>', "sizes above 0"),
        ('<cylinder radius="0.1"/>', "1 numbers"),
        ('<cone radius="0.1" length="1"/>', "box, sphere, cylinder, capsule or mesh"),
        ('<mesh filename="none.obj"/>', "none.obj"),
        ("", "<geometry> with a shape"),
    ],
)
@pytest.mark.parametrize("kind", ["visual", "collision"])
def test_wrong_shapes_are_refused(kind: str, shape: str, problem: str) -> None:
    good = f"<collision><geometry>{SHAPES[0]}</geometry></collision>"
    wrong = f'<link name="panel">{good}<{kind}><geometry>{shape}</geometry></{kind}></link>'
    with pytest.raises(InputError, match=re.escape(problem)) as caught:
        load_text(URDF.replace('<link name="panel"/>', wrong), BASE)
    assert Path(str(caught.value.file)).name == "thing.urdf"
    if "mesh" not in shape:
        assert str(caught.value.field).startswith("panel_")


def test_shapes_stand_where_pinocchio_has_them(tmp_path: Path) -> None:
    rng, shapes = np.random.default_rng(0), ""
    for xyz, rpy in zip(rng.uniform(-1.0, 1.0, (20, 3)).tolist(), rng.uniform(-3.0, 3.0, (20, 3)).tolist(), strict=True):
        origin = f'<origin xyz="{" ".join(map(str, xyz))}" rpy="{" ".join(map(str, rpy))}"/>'
        shapes += f"<collision>{origin}<geometry>{SHAPES[0]}</geometry></collision>"
    file = tmp_path / "thing.urdf"
    file.write_text(URDF.replace('<link name="panel"/>', f'<link name="panel">{shapes}</link>'))
    tree = load_urdf(file)
    theirs = pin.buildGeomFromUrdfString(tree.model, file.read_text(), pin.GeometryType.COLLISION).geometryObjects
    assert [s.name for s in tree.collision.geometryObjects] == [s.name for s in theirs]
    for ours, other in zip(tree.collision.geometryObjects, theirs, strict=True):
        np.testing.assert_allclose(ours.placement.homogeneous, other.placement.homogeneous, rtol=0.0, atol=1e-15)
        assert (ours.parentJoint, ours.parentFrame) == (other.parentJoint, other.parentFrame)


def test_capsules_and_colours_of_an_object() -> None:
    capsule = '<geometry><capsule radius="0.1" length="0.4"/></geometry>'
    red = '<material name="red"><color rgba="1 0 0 1"/></material>'
    panel = f'<link name="panel"><collision>{capsule}</collision><visual>{capsule}{red}</visual><visual>{capsule}</visual></link>'
    thing = load_text(URDF.replace('<link name="panel"/>', panel), BASE)
    (solid,) = (shape.geometry for shape in thing.collision.geometryObjects)
    assert (solid.radius, solid.halfLength) == (0.1, 0.2)
    assert [tuple(shape.meshColor) for shape in thing.visual.geometryObjects] == [(1.0, 0.0, 0.0, 1.0), (0.9, 0.9, 0.9, 1.0)]
    assert [shape.overrideMaterial for shape in thing.visual.geometryObjects] == [True, False]


@pytest.mark.parametrize("filename", ["wedge.obj", "package://things/wedge.obj"])
def test_collision_meshes_become_their_convex_hulls(tmp_path: Path, filename: str) -> None:
    folder = tmp_path / "things"
    folder.mkdir()
    (folder / "wedge.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n")
    mesh = f'<geometry><mesh filename="{filename}" scale="2 2 1"/></geometry>'
    (folder / "t.urdf").write_text(
        f'<robot name="t"><link name="l"><visual>{mesh}</visual><collision>{mesh}</collision></link></robot>'
    )
    (folder / "t.yaml").write_text("urdf: t.urdf\nattachments: [{name: a, link: l}]\n")
    (shape,) = load_object(folder / "t.yaml").collision.geometryObjects
    assert isinstance(shape.geometry, coal.ConvexBase)
    assert shape.geometry.computeVolume() == pytest.approx(4.0 / 6.0)
    (folder / "wedge.obj").write_text("nothing")
    with pytest.raises(InputError):
        load_object(folder / "t.yaml")


def test_unknown_objects_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError) as caught:
        load_object("dor")
    assert caught.value.nearest == "door"
    with pytest.raises(InputError) as missing:
        load_object(tmp_path / "none.yaml")
    assert missing.value.file == tmp_path / "none.yaml"
    (tmp_path / "thing.yaml").write_text("urdf: none.urdf\nattachments: [{name: a, link: b}]")
    with pytest.raises(InputError) as lost:
        load_object(tmp_path / "thing.yaml")
    assert lost.value.file == tmp_path / "none.urdf"
