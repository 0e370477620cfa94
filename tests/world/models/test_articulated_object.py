"""Tests articulated objects and the kinematics of attachments."""

from __future__ import annotations

import dataclasses

import numpy as np
import pinocchio as pin
import pytest
from helpers.expected_errors import expect_error
from helpers.objects import URDF, load_object_text
from scipy.spatial.transform import Rotation

from vkc_pin import Latch, load_object


def test_door_properties() -> None:
    door = load_object("door")
    assert door.coordinates.names == ("hinge", "knob")
    assert (door.base_link, door.links) == ("frame", ("frame", "panel", "lever"))
    assert not door.free
    assert door.latches == (Latch("hinge", 0.0, "knob", 0.5, 0.05),)
    assert list(door.attachments) == ["handle", "handle_free", "push", "push_back"]
    assert door.attachment() is door.attachment("handle")
    with expect_error(nearest="handle"):
        door.attachment("handel")


GRASPS = [
    ("fixed", "", ()),
    ("revolute", "axis: [1, 2, -2], limits: [-0.4, 0.5]", ("",)),
    ("prismatic", "axis: [1, 2, -2], limits: [-0.4, 0.5]", ("",)),
    (
        "cylindrical",
        "axis: [1, 2, -2], limits: [-0.4, 0.5], turn: [-1.2, 1.1]",
        ("_slide", "_turn"),
    ),
    ("spherical", "", ("_x", "_y", "_z")),
    ("spherical", "limits: [-0.4, 0.5]", ("_x", "_y", "_z")),
]


@pytest.mark.parametrize(("joint", "fields", "suffixes"), GRASPS)
@pytest.mark.parametrize("standoff", [0.0, 0.07])
def test_attachments_move_with_their_virtual_joint(
    joint: str, fields: str, suffixes: tuple[str, ...], standoff: float
) -> None:
    entry = ", ".join(
        part
        for part in (f"name: grip, link: panel, joint: {joint}, standoff: {standoff}", fields)
        if part
    )
    grip = load_object_text(URDF, f"urdf: thing.urdf\nattachments: [{{{entry}}}]").attachment()
    placement = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.2, 1.0), np.array([0.1, 0.2, -0.3]))
    grip = dataclasses.replace(grip, placement=placement)
    assert (grip.joint, grip.standoff) == (joint, standoff)
    assert grip.coordinates == tuple(f"grip{suffix}" for suffix in suffixes)
    limits = {"_turn": (-1.2, 1.1)} if joint == "cylindrical" else {}
    default = (-0.4, 0.5) if "limits" in fields else (-np.pi, np.pi)
    assert [(f.lower, f.upper) for f in grip.freedoms] == [
        limits.get(suffix, default) for suffix in suffixes
    ]
    v, axis = (
        np.random.default_rng(0).uniform(-1.0, 1.0, len(suffixes)),
        np.array([1.0, 2.0, -2.0]) / 3.0,
    )
    turn, centre = Rotation.identity(), np.zeros(3)
    if joint == "spherical":
        turn = Rotation.from_euler("XYZ", v)
    elif joint != "fixed":
        turn = Rotation.from_rotvec(axis * (v[-1] if joint != "prismatic" else 0.0))
        centre = axis * (v[0] if joint != "revolute" else 0.0)
    moved = grip.motion(v)
    np.testing.assert_allclose(moved.rotation, turn.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(
        moved.translation, centre + turn.apply([0.0, 0.0, -standoff]), atol=1e-12
    )
    np.testing.assert_allclose(
        grip.tool(v).homogeneous, placement.homogeneous @ moved.homogeneous, atol=1e-12
    )
    with expect_error("one per freedom"):
        grip.motion([*v, 0.0])


def test_listed_freedoms_are_applied_in_order() -> None:
    """On a rim of radius 0.3 m the hand moves around, tilts, then slides; checked with SciPy."""
    entry = """
  - name: rim
    link: panel
    position: [0.3, 0, 0.1]
    approach: [0, 0, -1]
    closing: [1, 0, 0]
    freedoms:
      - {name: around, turn: [0, 0, 2], through: [-0.3, 0, 0], limits: [-3, 3]}
      - {name: tilt, turn: [0, 1, 0], limits: [-0.5, 0.5]}
      - {name: slide, slide: [3, 0, 4], limits: [0, 0.02]}"""
    rim = load_object_text(URDF, f"urdf: thing.urdf\nattachments: {entry}").attachment()
    assert rim.coordinates == ("rim_around", "rim_tilt", "rim_slide")
    assert [freedom.unit for freedom in rim.freedoms] == ["rad", "rad", "m"]
    assert [(freedom.lower, freedom.upper) for freedom in rim.freedoms] == [
        (-3, 3),
        (-0.5, 0.5),
        (0, 0.02),
    ]
    rng = np.random.default_rng(3)
    down = np.diag([1.0, -1.0, -1.0])
    for around, tilt, slide in rng.uniform([-3, -0.5, 0], [3, 0.5, 0.02], (5, 3)):
        tool = rim.tool([around, tilt, slide])
        spin = Rotation.from_euler("z", -around).as_matrix()  # opposite direction, seen from above
        turn = spin @ down @ Rotation.from_euler("y", tilt).as_matrix()
        np.testing.assert_allclose(tool.rotation, turn, rtol=0.0, atol=1e-12)
        at = spin @ [0.3, 0.0, 0.0] + [0.0, 0.0, 0.1] + turn @ [0.6 * slide, 0.0, 0.8 * slide]
        np.testing.assert_allclose(tool.translation, at, rtol=0.0, atol=1e-12)
