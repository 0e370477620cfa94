"""Tests object descriptions and the errors of invalid ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.expected_errors import expect_error
from helpers.meshes import write_wedge
from helpers.objects import SHAPES, URDF, load_object_text

from vkc_pin import load_object
from vkc_pin.world.models.articulated_object import DEFAULT_ACCELERATION, DEFAULT_VELOCITY

ALONG = "name: along, slide: [1, 0, 0], limits: [0, 0.1]"
SLIDE = "    axis: [0, 1, 0]\n    limits: [-0.1, 0.2]"


DESCRIPTION = """urdf: thing.urdf
joints:
  hinge: {acceleration: 3}
attachments:
  - name: grip
    link: panel
latches:
  - {joint: hinge, released_by: knob, threshold: 0.5, engaged_within: 0.05}
"""


def test_attachments_may_be_empty_but_not_missing() -> None:
    item = load_object_text(URDF, "urdf: thing.urdf\nattachments: []")
    assert dict(item.attachments) == {}
    with expect_error("no attachment"):
        item.attachment()
    with expect_error("attachments"):
        load_object_text(URDF, "urdf: thing.urdf")


def test_default_limits() -> None:
    item = load_object_text(URDF, DESCRIPTION)
    np.testing.assert_array_equal(item.velocity, [1.0, DEFAULT_VELOCITY])
    np.testing.assert_array_equal(item.acceleration, [3.0, DEFAULT_ACCELERATION])


@pytest.mark.parametrize(
    ("free", "stated", "firm"),
    [(0, "", 0), (1, "", 1), (0, "firm: true", 1), (1, "firm: false", 0)],
)
def test_grasps_of_free_objects_are_firm_by_default(free: int, stated: str, firm: int) -> None:
    text = (
        f"urdf: thing.urdf\nfree: {bool(free)}\n"
        f"attachments: [{{name: grip, link: panel, {stated}}}]"
    )
    assert load_object_text(URDF, text).attachment().firm is bool(firm)


def test_conflicting_attachments_raise() -> None:
    push = "{name: grip, link: panel, contact: push}"
    with expect_error("cannot be pushed", line=3, field="attachments[0].contact"):
        load_object_text(URDF, f"urdf: thing.urdf\nfree: true\nattachments: [{push}]")
    slide = "link: panel, axis: [1, 0, 0], limits: [0, 1]"
    grip = f"{{name: grip, joint: cylindrical, turn: [0, 1], {slide}}}"
    other = f"{{name: grip_slide, joint: prismatic, {slide}}}"
    with expect_error("grip_slide", field="attachments[1].name"):
        load_object_text(URDF, f"urdf: thing.urdf\nattachments: [{grip}, {other}]")


@pytest.mark.parametrize(
    ("entry", "line", "field"),
    [
        ("joint: revolute", 5, "attachments[0]"),
        ("joint: revolute\n    axis: [0, 0, 0]", 8, "attachments[0].axis"),
        (
            "joint: revolute\n    axis: [0, 0, 1]\n    limits: [0.1, 1]",
            9,
            "attachments[0].limits",
        ),
        ("joint: spherical\n    axis: [0, 0, 1]", 5, "attachments[0]"),
        (f"joint: cylindrical\n{SLIDE}", 5, "attachments[0]"),
        (f"joint: cylindrical\n{SLIDE}\n    turn: [1, 2]", 10, "attachments[0].turn"),
        (f"joint: revolute\n{SLIDE}\n    turn: [-1, 1]", 5, "attachments[0]"),
        ("standoff: -0.01", 7, "attachments[0].standoff"),
        ("firm: 2", 7, "attachments[0].firm"),
        ("clearance: -0.001", 7, "attachments[0].clearance"),
        ("opening: wide", 7, "attachments[0].opening"),
        ("contact: pull", 7, "attachments[0].contact"),
        ("contact: push\n    firm: true", 5, "attachments[0]"),
        (f"freedoms: [{{{ALONG}}}, {{{ALONG}}}]", 5, "attachments[0]"),
        (f"joint: spherical\n    freedoms: [{{{ALONG}}}]", 5, "attachments[0]"),
        (f"freedoms: [{{{ALONG}, turn: [0, 0, 1]}}]", 7, "attachments[0].freedoms[0]"),
        (f"freedoms: [{{{ALONG}, through: [0, 0, 1]}}]", 7, "attachments[0].freedoms[0]"),
        ("freedoms: [{name: up, limits: [0, 1]}]", 7, "attachments[0].freedoms[0]"),
        ("approach: [1, 0, 0]", 5, "attachments[0]"),
        ("approach: [1, 0, 0]\n    closing: [1, 0, 1]", 5, "attachments[0]"),
    ],
)
def test_invalid_attachments_raise_with_their_line(entry: str, line: int, field: str) -> None:
    with expect_error(line=line, field=field):
        load_object_text(URDF, DESCRIPTION.replace("link: panel", f"link: panel\n    {entry}"))


@pytest.mark.parametrize(
    ("old", "new", "line", "field", "message"),
    [
        (
            "acceleration",
            "aceleration",
            3,
            "joints.hinge.aceleration",
            "did you mean 'acceleration'",
        ),
        ("  hinge:", "  hingge:", 3, "joints.hingge", "did you mean 'hinge'"),
        ("link: panel", "link: panell", 6, "attachments[0].link", "did you mean 'panel'"),
        ("joint: hinge", "joint: hinges", 8, "latches[0].joint", "did you mean 'hinge'"),
        (
            "released_by: knob",
            "released_by: knot",
            8,
            "latches[0].released_by",
            "did you mean 'knob'",
        ),
        (
            "link: panel",
            "link: panel\n    joint: revolut",
            7,
            "attachments[0].joint",
            "did you mean 'revolute'",
        ),
        ("acceleration: 3", "acceleration: -3", 3, "joints.hinge.acceleration", ""),
        ("acceleration: 3", "acceleration: 1e-300", 3, "joints.hinge.acceleration", ""),
        ("acceleration: 3", "velocity: 1e-7", 3, "joints.hinge.velocity", ""),
        ("link: panel", "position: [0, 0, 0]", 5, "attachments[0].link", ""),
        (
            "link: panel",
            "link: panel\n  - name: grip\n    link: panel",
            7,
            "attachments[1].name",
            "",
        ),
        ("joint: hinge,", "joint: hinge, held_at: 2,", 8, "latches[0].held_at", ""),
        ("released_by: knob", "released_by: hinge", 8, "latches[0].released_by", ""),
        (
            "engaged_within: 0.05",
            "engaged_within: 0",
            8,
            "latches[0].engaged_within",
            "",
        ),
    ],
)
def test_invalid_values_raise_with_their_line(
    old: str, new: str, line: int, field: str, message: str
) -> None:
    with expect_error(rf"thing\.yaml.*{message}", line=line, field=field):
        load_object_text(URDF, DESCRIPTION.replace(old, new))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('type="continuous"', 'type="floating"', "knob: this joint type is not supported"),
        (
            '<axis xyz="1 0 0"/>',
            '<axis xyz="1 0 0"/><mimic joint="hinge"/>',
            "knob: joints that mimic",
        ),
        ('velocity="1"', 'velocity="0"', "hinge.limit.velocity"),
        (
            '<link name="panel"/>',
            f'<link name="panel"><visual><geometry>{SHAPES[0]}</geometry></visual></link>',
            "nothing in this URDF can collide",
        ),
    ],
)
def test_invalid_urdfs_raise(old: str, new: str, message: str) -> None:
    with expect_error(rf"thing\.urdf.*{message}"):
        load_object_text(URDF.replace(old, new), DESCRIPTION)


@pytest.mark.parametrize(
    ("shape", "problem"),
    [
        ('<box size="1,5 2 3"/>', "3 finite numbers"),
        ('<box size="1 -2 3"/>', "sizes above 0"),
        ('<cylinder radius="0.1"/>', "1 finite number"),
        ('<cone radius="0.1" length="1"/>', "box, sphere, cylinder, capsule or mesh"),
        ("", "<geometry> with a shape"),
    ],
)
@pytest.mark.parametrize("kind", ["visual", "collision"])
def test_invalid_shapes_raise(kind: str, shape: str, problem: str) -> None:
    good = f"<collision><geometry>{SHAPES[0]}</geometry></collision>"
    wrong = f'<link name="panel">{good}<{kind}><geometry>{shape}</geometry></{kind}></link>'
    with expect_error(f"panel_.*{problem}"):
        load_object_text(URDF.replace('<link name="panel"/>', wrong), DESCRIPTION)


def test_unknown_objects_raise(tmp_path: Path) -> None:
    with expect_error(nearest="door"):
        load_object("dor")
    with expect_error(file=tmp_path / "none.yaml"):
        load_object(tmp_path / "none.yaml")
    (tmp_path / "thing.yaml").write_text("urdf: none.urdf\nattachments: [{name: a, link: b}]")
    with expect_error(file=tmp_path / "none.urdf"):
        load_object(tmp_path / "thing.yaml")


def test_descriptions_can_be_mappings(tmp_path: Path) -> None:
    write_wedge(tmp_path / "wedge.obj")
    mesh = '<collision><geometry><mesh filename="wedge.obj"/></geometry></collision>'
    urdf = f'<robot name="wedge"><link name="base">{mesh}</link></robot>'
    description = {"urdf": urdf, "free": True, "attachments": [{"name": "grip", "link": "base"}]}
    item = load_object(description, folder=tmp_path)
    assert (item.name, item.urdf, item.free) == ("wedge", None, True)
    assert item.collision.geometryObjects[0].geometry.num_points == 4
    with expect_error(r"wedge\.obj"):
        load_object(description, folder=tmp_path / "elsewhere")
    file = tmp_path / "wedge.urdf"
    file.write_text(urdf)
    assert load_object({**description, "urdf": "wedge.urdf"}, folder=tmp_path).urdf == file
