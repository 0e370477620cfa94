"""Tests articulated objects and the kinematics of attachments."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pinocchio as pin
import pytest
from helpers.objects import URDF, load_text
from scipy.spatial.transform import Rotation

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.world.models.object_file import load_object
from vkc_pin.world.models.shapes import compute_clearance, list_placed_shapes
from vkc_pin.world.scene.placed_object import PlacedObject, make_world_shapes


def test_door_properties() -> None:
    door = load_object("door")
    assert door.coordinates.names == ("hinge", "knob")
    assert (door.base_link, door.links) == ("frame", ("frame", "panel", "lever"))
    assert not door.free
    np.testing.assert_array_equal(door.lower, [-1.57, 0.0])
    np.testing.assert_array_equal(door.upper, [1.57, 0.8])
    np.testing.assert_array_equal(door.velocity, [1.0, 2.0])
    np.testing.assert_array_equal(door.acceleration, [1.0, 4.0])
    (latch,) = door.latches
    assert (
        latch.joint,
        latch.held_at,
        latch.released_by,
        latch.threshold,
        latch.engaged_within,
    ) == (
        "hinge",
        0.0,
        "knob",
        0.5,
        0.05,
    )
    assert list(door.attachments) == ["handle", "handle_free", "push", "push_back"]
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


def test_door_kinematics() -> None:
    door = load_object("door")
    closed, pushed = (
        door.link_placement("lever", [hinge, 0.0]).translation for hinge in (0.0, 1.0)
    )
    assert pushed[0] > closed[0] + 0.5, (
        "hinge > 0 pushes the panel away from the handle's side, towards +x"
    )
    level, turned = (
        door.link_placement("lever", [0.0, knob]) * door.attachment().placement
        for knob in (0.0, 0.5)
    )
    assert turned.translation[2] < level.translation[2] - 0.02, (
        "knob > 0 turns the lever's end down"
    )
    np.testing.assert_allclose(
        level.rotation[:, 2], [1.0, 0.0, 0.0], atol=1e-12
    )  # the tool approaches along +x
    np.testing.assert_allclose(
        level.rotation[:, 0], [0.0, 0.0, 1.0], atol=1e-12
    )  # and closes across the bar
    assert 0.95 <= level.translation[2] <= 1.0
    assert -0.125 - 0.02 <= level.translation[0] <= -0.07 - 0.02, (
        "the bar stands in front of the panel's face at -0.02"
    )


def test_drawer_properties() -> None:
    drawer = load_object("drawer")
    assert drawer.coordinates.names == ("slide",)
    assert (drawer.lower[0], drawer.upper[0], drawer.velocity[0], drawer.acceleration[0]) == (
        0.0,
        0.4,
        0.5,
        1.0,
    )
    assert drawer.latches == ()
    assert list(drawer.attachments) == ["handle", "handle_free", "push"]
    moved = (
        drawer.link_placement("tray", [0.4]).translation
        - drawer.link_placement("tray", [0.0]).translation
    )
    np.testing.assert_allclose(moved, [-0.4, 0.0, 0.0], atol=1e-12)  # out of the cabinet


@pytest.mark.parametrize(("name", "steps"), [("door", (158, 3)), ("drawer", (41,))])
def test_moving_links_do_not_collide_with_the_base(name: str, steps: tuple[int, ...]) -> None:
    thing = load_object(name)
    still = [s for s in thing.collision.geometryObjects if s.parentJoint == 0]
    assert len(still) >= 3
    grids = [
        np.linspace(*limits, n) for *limits, n in zip(thing.lower, thing.upper, steps, strict=True)
    ]
    nearest = np.inf
    for state in itertools.product(*grids):
        placed = make_world_shapes(PlacedObject(name, thing, pin.SE3.Identity(), np.array(state)))
        moving = [
            s
            for s, original in zip(placed, thing.collision.geometryObjects, strict=True)
            if original.parentJoint != 0
        ]
        nearest = min(
            nearest, compute_clearance(list_placed_shapes(moving), list_placed_shapes(still))
        )
    assert 0.02 < nearest < 0.05


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
    grip = load_text(URDF, f"urdf: thing.urdf\nattachments: [{{{entry}}}]").attachment()
    placement = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.2, 1.0), np.array([0.1, 0.2, -0.3]))
    grip = dataclasses.replace(grip, placement=placement)
    assert (grip.joint, grip.standoff) == (joint, standoff)
    assert grip.coordinates == tuple(f"grip{suffix}" for suffix in suffixes)
    stated = {"_turn": (-1.2, 1.1)} if joint == "cylindrical" else {}
    usual = (-0.4, 0.5) if "limits" in fields else (-np.pi, np.pi)
    assert [(f.lower, f.upper) for f in grip.freedoms] == [
        stated.get(suffix, usual) for suffix in suffixes
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
    with pytest.raises(InputError, match="one per freedom"):
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
    rim = load_text(URDF, f"urdf: thing.urdf\nattachments: {entry}").attachment()
    assert (rim.joint, rim.coordinates) == ("listed", ("rim_around", "rim_tilt", "rim_slide"))
    assert [(own.kind, own.unit, own.lower, own.upper) for own in rim.freedoms] == [
        ("revolute", "rad", -3.0, 3.0),
        ("revolute", "rad", -0.5, 0.5),
        ("prismatic", "m", 0.0, 0.02),
    ]
    rng = np.random.default_rng(3)
    down = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    for around, tilt, slide in rng.uniform([-3, -0.5, 0], [3, 0.5, 0.02], (20, 3)):
        tool = rim.tool([around, tilt, slide])
        spin = Rotation.from_euler("z", -around).as_matrix()  # opposite direction, seen from above
        turn = spin @ down @ Rotation.from_euler("y", tilt).as_matrix()
        np.testing.assert_allclose(tool.rotation, turn, rtol=0.0, atol=1e-12)
        at = spin @ [0.3, 0.0, 0.0] + [0.0, 0.0, 0.1] + turn @ [0.6 * slide, 0.0, 0.8 * slide]
        np.testing.assert_allclose(tool.translation, at, rtol=0.0, atol=1e-12)
