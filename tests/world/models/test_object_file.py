"""Tests object descriptions and the errors of invalid ones."""

from __future__ import annotations

import re
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest
from helpers.objects import SHAPES, URDF, load_text

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.world.files.urdf import load_urdf
from vkc_pin.world.models.articulated_object import DEFAULT_ACCELERATION, DEFAULT_VELOCITY
from vkc_pin.world.models.object_file import load_object

ALONG = "name: along, slide: [1, 0, 0], limits: [0, 0.1]"
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


def test_attachments_may_be_empty_but_not_missing() -> None:
    item = load_text(URDF, "urdf: thing.urdf\nattachments: []")
    assert dict(item.attachments) == {}
    with pytest.raises(InputError, match="no attachment"):
        item.attachment()
    with pytest.raises(InputError, match="attachments"):
        load_text(URDF, "urdf: thing.urdf")


def test_default_limits() -> None:
    thing = load_text(URDF, BASE)
    np.testing.assert_array_equal(thing.velocity, [1.0, DEFAULT_VELOCITY])
    np.testing.assert_array_equal(thing.acceleration, [3.0, DEFAULT_ACCELERATION])


@pytest.mark.parametrize(
    ("free", "stated", "firm"),
    [(0, "", 0), (1, "", 1), (0, "firm: true", 1), (1, "firm: false", 0)],
)
def test_grasps_of_free_objects_are_firm_by_default(free: int, stated: str, firm: int) -> None:
    text = (
        f"urdf: thing.urdf\nfree: {bool(free)}\n"
        f"attachments: [{{name: grip, link: panel, {stated}}}]"
    )
    assert load_text(URDF, text).attachment().firm is bool(firm)


def test_free_objects_cannot_be_pushed() -> None:
    with pytest.raises(InputError, match="cannot be pushed") as caught:
        load_text(
            URDF,
            "urdf: thing.urdf\nfree: true\nattachments: [{name: grip, link: panel, contact: push}]",
        )
    assert (caught.value.line, caught.value.field) == (3, "attachments[0].contact")


def test_duplicate_coordinate_names_raise() -> None:
    slide = "name: grip_slide, link: panel, joint: prismatic, axis: [1, 0, 0], limits: [0, 1]"
    grip = (
        "name: grip, link: panel, joint: cylindrical, axis: [1, 0, 0], limits: [0, 1], turn: [0, 1]"
    )
    both = f"{{{grip}}}, {{{slide}}}"
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
def test_unknown_names_raise_with_a_suggestion(
    old: str, new: str, line: int, field: str, nearest: str
) -> None:
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
        (
            "link: panel",
            "link: panel\n    joint: revolute\n    axis: [0, 0, 0]",
            8,
            "attachments[0].axis",
        ),
        (
            "link: panel",
            "link: panel\n    joint: revolute\n    axis: [0, 0, 1]\n    limits: [0.1, 1]",
            9,
            "attachments[0].limits",
        ),
        (
            "link: panel",
            "link: panel\n    joint: spherical\n    axis: [0, 0, 1]",
            5,
            "attachments[0]",
        ),
        (
            "link: panel",
            "link: panel\n    joint: spherical\n    limits: [0.1, 1]",
            8,
            "attachments[0].limits",
        ),
        ("link: panel", f"link: panel\n    joint: cylindrical\n{SLIDE}", 5, "attachments[0]"),
        (
            "link: panel",
            f"link: panel\n    joint: cylindrical\n{SLIDE}\n    turn: [1, 2]",
            10,
            "attachments[0].turn",
        ),
        (
            "link: panel",
            f"link: panel\n    joint: cylindrical\n{SLIDE}\n    turn: 1.2",
            10,
            "attachments[0].turn",
        ),
        (
            "link: panel",
            "link: panel\n    joint: cylindrical\n    axis: [0, 1, 0]\n    turn: [-1, 1]",
            5,
            "attachments[0]",
        ),
        (
            "link: panel",
            "link: panel\n    joint: cylindrical\n    limits: [-1, 1]\n    turn: [-1, 1]",
            5,
            "attachments[0]",
        ),
        (
            "link: panel",
            f"link: panel\n    joint: revolute\n{SLIDE}\n    turn: [-1, 1]",
            5,
            "attachments[0]",
        ),
        ("link: panel", "link: panel\n    turn: [-1, 1]", 5, "attachments[0]"),
        ("link: panel", "link: panel\n    standoff: -0.01", 7, "attachments[0].standoff"),
        ("link: panel", "link: panel\n    firm: 2", 7, "attachments[0].firm"),
        ("link: panel", "link: panel\n    clearance: -0.001", 7, "attachments[0].clearance"),
        ("link: panel", "link: panel\n    opening: -0.001", 7, "attachments[0].opening"),
        ("link: panel", "link: panel\n    opening: wide", 7, "attachments[0].opening"),
        ("link: panel", "link: panel\n    contact: pull", 7, "attachments[0].contact"),
        ("link: panel", "link: panel\n    contact: push\n    firm: true", 5, "attachments[0]"),
        (
            "link: panel",
            f"link: panel\n    freedoms: [{{{ALONG}}}, {{{ALONG}}}]",
            5,
            "attachments[0]",
        ),
        (
            "link: panel",
            f"link: panel\n    joint: spherical\n    freedoms: [{{{ALONG}}}]",
            5,
            "attachments[0]",
        ),
        (
            "link: panel",
            f"link: panel\n    freedoms: [{{{ALONG}, turn: [0, 0, 1]}}]",
            7,
            "attachments[0].freedoms[0]",
        ),
        (
            "link: panel",
            f"link: panel\n    freedoms: [{{{ALONG}, through: [0, 0, 1]}}]",
            7,
            "attachments[0].freedoms[0]",
        ),
        (
            "link: panel",
            "link: panel\n    freedoms: [{name: up, limits: [0, 1]}]",
            7,
            "attachments[0].freedoms[0]",
        ),
        (
            "link: panel",
            "link: panel\n    freedoms: [{name: up, slide: [0, 0, 0], limits: [0, 1]}]",
            7,
            "attachments[0].freedoms[0].slide",
        ),
        ("link: panel", "link: panel\n    approach: [1, 0, 0]", 5, "attachments[0]"),
        (
            "link: panel",
            "link: panel\n    approach: [1, 0, 0]\n    closing: [1, 0, 1]",
            5,
            "attachments[0]",
        ),
        ("link: panel", "link: panel\n  - name: grip\n    link: panel", 7, "attachments[1].name"),
        ("joint: hinge,", "joint: hinge, held_at: 2,", 8, "latches[0].held_at"),
        ("released_by: knob", "released_by: hinge", 8, "latches[0].released_by"),
        ("engaged_within: 0.05", "engaged_within: 0", 8, "latches[0].engaged_within"),
        ("latches:", "urdf: thing.urdf\nlatches:", 7, "urdf"),
        ("link: panel", "link: [panel", 7, None),
    ],
)
def test_invalid_values_raise_with_their_line(
    old: str, new: str, line: int, field: str | None
) -> None:
    with pytest.raises(InputError) as caught:
        load_text(URDF, BASE.replace(old, new))
    assert (caught.value.line, caught.value.field) == (line, field), str(caught.value)
    assert Path(str(caught.value.file)).name == "thing.yaml"


@pytest.mark.parametrize(
    ("urdf", "message"),
    [
        (URDF.replace("</robot>", ""), "not valid XML"),
        (URDF.replace("robot", "model"), "expected an element <robot>"),
        (
            URDF.replace('type="continuous"', 'type="floating"'),
            "knob: this joint type is not supported",
        ),
        (
            URDF.replace('<axis xyz="1 0 0"/>', '<axis xyz="1 0 0"/><mimic joint="hinge"/>'),
            "knob: joints that mimic",
        ),
        (URDF.replace('velocity="1"', 'velocity="0"'), "hinge.limit.velocity"),
        (
            URDF.replace('child link="lever"', 'child link="lver"'),
            "knob: child: there is no link 'lver'; did you mean 'lever'",
        ),
        (
            URDF.replace(
                '<link name="panel"/>',
                f'<link name="panel"><visual><geometry>{SHAPES[0]}</geometry></visual></link>',
            ),
            "nothing in this URDF can collide",
        ),
    ],
)
def test_invalid_urdfs_raise(urdf: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        load_text(urdf, BASE)
    assert message in str(caught.value)
    assert Path(str(caught.value.file)).name == "thing.urdf"


@pytest.mark.parametrize(
    ("shape", "problem"),
    [
        ('<box size="nan 5.8 2"/>', "3 finite numbers"),
        ('<box size="1 2"/>', "3 finite numbers"),
        ('<box size="1,5 2 3"/>', "3 finite numbers"),
        ("<box/>", "3 finite numbers"),
        ('<box size="1 -2 3"/>', "sizes above 0"),
        ('<sphere radius="0"/>', "sizes above 0"),
        ('<cylinder radius="0.1"/>', "1 finite number"),
        ('<cone radius="0.1" length="1"/>', "box, sphere, cylinder, capsule or mesh"),
        ('<mesh filename="none.obj"/>', "none.obj"),
        ("", "<geometry> with a shape"),
    ],
)
@pytest.mark.parametrize("kind", ["visual", "collision"])
def test_invalid_shapes_raise(kind: str, shape: str, problem: str) -> None:
    good = f"<collision><geometry>{SHAPES[0]}</geometry></collision>"
    wrong = f'<link name="panel">{good}<{kind}><geometry>{shape}</geometry></{kind}></link>'
    with pytest.raises(InputError, match=re.escape(problem)) as caught:
        load_text(URDF.replace('<link name="panel"/>', wrong), BASE)
    assert Path(str(caught.value.file)).name == "thing.urdf"
    if "mesh" not in shape:
        assert str(caught.value.field).startswith("panel_")


def test_shape_placements_match_pinocchio(tmp_path: Path) -> None:
    rng, shapes = np.random.default_rng(0), ""
    for xyz, rpy in zip(
        rng.uniform(-1.0, 1.0, (20, 3)).tolist(),
        rng.uniform(-3.0, 3.0, (20, 3)).tolist(),
        strict=True,
    ):
        origin = f'<origin xyz="{" ".join(map(str, xyz))}" rpy="{" ".join(map(str, rpy))}"/>'
        shapes += f"<collision>{origin}<geometry>{SHAPES[0]}</geometry></collision>"
    file = tmp_path / "thing.urdf"
    file.write_text(URDF.replace('<link name="panel"/>', f'<link name="panel">{shapes}</link>'))
    model, collision, _ = load_urdf(file)
    theirs = pin.buildGeomFromUrdfString(
        model, file.read_text(), pin.GeometryType.COLLISION
    ).geometryObjects
    assert [s.name for s in collision.geometryObjects] == [s.name for s in theirs]
    for ours, other in zip(collision.geometryObjects, theirs, strict=True):
        np.testing.assert_allclose(
            ours.placement.homogeneous, other.placement.homogeneous, rtol=0.0, atol=1e-15
        )
        assert (ours.parentJoint, ours.parentFrame) == (other.parentJoint, other.parentFrame)


def test_capsules_and_colours_are_read() -> None:
    capsule = '<geometry><capsule radius="0.1" length="0.4"/></geometry>'
    red = '<material name="red"><color rgba="1 0 0 1"/></material>'
    panel = (
        f'<link name="panel"><collision>{capsule}</collision>'
        f"<visual>{capsule}{red}</visual><visual>{capsule}</visual></link>"
    )
    thing = load_text(URDF.replace('<link name="panel"/>', panel), BASE)
    (solid,) = (shape.geometry for shape in thing.collision.geometryObjects)
    assert (solid.radius, solid.halfLength) == (0.1, 0.2)
    assert [tuple(shape.meshColor) for shape in thing.visual.geometryObjects] == [
        (1.0, 0.0, 0.0, 1.0),
        (0.9, 0.9, 0.9, 1.0),
    ]
    assert [shape.overrideMaterial for shape in thing.visual.geometryObjects] == [True, False]


@pytest.mark.parametrize("filename", ["wedge.obj", "package://things/wedge.obj"])
def test_collision_meshes_become_convex_hulls(tmp_path: Path, filename: str) -> None:
    folder = tmp_path / "things"
    folder.mkdir()
    (folder / "wedge.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
    )
    mesh = f'<geometry><mesh filename="{filename}" scale="2 2 1"/></geometry>'
    (folder / "t.urdf").write_text(
        f'<robot name="t"><link name="l"><visual>{mesh}</visual>'
        f"<collision>{mesh}</collision></link></robot>"
    )
    (folder / "t.yaml").write_text("urdf: t.urdf\nattachments: [{name: a, link: l}]\n")
    (shape,) = load_object(folder / "t.yaml").collision.geometryObjects
    assert isinstance(shape.geometry, coal.ConvexBase)
    assert shape.geometry.computeVolume() == pytest.approx(4.0 / 6.0)
    (folder / "wedge.obj").write_text("nothing")
    with pytest.raises(InputError):
        load_object(folder / "t.yaml")


def test_unknown_objects_raise(tmp_path: Path) -> None:
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


def test_descriptions_can_be_mappings(tmp_path: Path) -> None:
    (tmp_path / "wedge.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
    )
    mesh = '<collision><geometry><mesh filename="wedge.obj"/></geometry></collision>'
    urdf = f'<robot name="wedge"><link name="base">{mesh}</link></robot>'
    description = {"urdf": urdf, "free": True, "attachments": [{"name": "grip", "link": "base"}]}
    thing = load_object(description, folder=tmp_path)
    assert (thing.name, thing.urdf, thing.free) == ("wedge", None, True)
    assert thing.collision.geometryObjects[0].geometry.num_points == 4
    with pytest.raises(InputError, match=r"wedge\.obj"):
        load_object(description, folder=tmp_path / "elsewhere")
    with pytest.raises(InputError, match="expected text"):
        load_object({1: urdf})  # type: ignore[dict-item]
    (tmp_path / "wedge.urdf").write_text(urdf)
    assert (
        load_object({**description, "urdf": "wedge.urdf"}, folder=tmp_path).urdf
        == tmp_path / "wedge.urdf"
    )
