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
    assert (door.base_link, door.links) == ("frame", ("frame", "panel", "lever"))
    assert door.latches == (Latch("hinge", 0.0, "knob", 0.5, 0.05),)
    assert list(door.attachments) == ["handle", "handle_free", "push", "push_back"]
    assert door.attachment() is door.attachment("handle")
    with expect_error(nearest="handle"):
        door.attachment("handel")


AXIS, MIN, MAX = "axis: [1, 2, -2]", -0.4, 0.5
ALL = (-np.pi, np.pi)


@pytest.mark.parametrize(
    ("joint", "fields", "limits"),
    [
        ("fixed", "", {}),
        ("revolute", f"{AXIS}, limits: [-0.4, 0.5]", {"": (MIN, MAX)}),
        ("prismatic", f"{AXIS}, limits: [-0.4, 0.5]", {"": (MIN, MAX)}),
        (
            "cylindrical",
            f"{AXIS}, limits: [-0.4, 0.5], turn: [-1.2, 1.1]",
            {"_slide": (MIN, MAX), "_turn": (-1.2, 1.1)},
        ),
        ("spherical", "", {"_x": ALL, "_y": ALL, "_z": ALL}),
        ("spherical", "limits: [-0.4, 0.5]", dict.fromkeys(("_x", "_y", "_z"), (MIN, MAX))),
    ],
)
@pytest.mark.parametrize("standoff", [0.0, 0.07])
def test_attachments_move_with_their_virtual_joint(
    joint: str, fields: str, limits: dict[str, tuple[float, float]], standoff: float
) -> None:
    entry = f"name: grip, link: panel, joint: {joint}, standoff: {standoff}, {fields}"
    grip = load_object_text(URDF, f"urdf: thing.urdf\nattachments: [{{{entry}}}]").attachment()
    placement = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.2, 1.0), np.array([0.1, 0.2, -0.3]))
    grip = dataclasses.replace(grip, placement=placement)
    assert (grip.joint, grip.standoff) == (joint, standoff)
    found = {
        name: (freedom.lower, freedom.upper)
        for name, freedom in zip(grip.coordinates, grip.freedoms, strict=True)
    }
    assert found == {f"grip{suffix}": ends for suffix, ends in limits.items()}
    v = np.random.default_rng(0).uniform(-1.0, 1.0, len(limits))
    axis, turn, centre = np.array([1.0, 2.0, -2.0]) / 3.0, np.eye(3), np.zeros(3)
    if joint == "spherical":
        turn = Rotation.from_euler("XYZ", v).as_matrix()
    if joint in ("revolute", "cylindrical"):
        turn = pin.AngleAxis(v[-1], axis).matrix()
    if joint in ("prismatic", "cylindrical"):
        centre = axis * v[0]
    expected = pin.SE3(turn, centre) * pin.SE3(np.eye(3), np.array([0.0, 0.0, -standoff]))
    np.testing.assert_allclose(grip.motion(v), expected, atol=1e-12)
    np.testing.assert_allclose(grip.tool(v), placement * expected, atol=1e-12)
    with expect_error("one per freedom"):
        grip.motion([*v, 0.0])


def test_listed_freedoms_are_applied_in_order() -> None:
    """On a rim of radius 0.3 m the hand moves around, tilts, then slides."""
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
    assert [(one.unit, one.lower, one.upper) for one in rim.freedoms] == [
        ("rad", -3, 3),
        ("rad", -0.5, 0.5),
        ("m", 0, 0.02),
    ]
    rng = np.random.default_rng(3)
    for around, tilt, slide in rng.uniform([-3, -0.5, 0], [3, 0.5, 0.02], (5, 3)):
        spin = pin.utils.rotate("z", -around)  # opposite direction, seen from above
        turn = spin @ np.diag([1.0, -1.0, -1.0]) @ pin.utils.rotate("y", tilt)
        at = spin @ [0.3, 0.0, 0.0] + [0.0, 0.0, 0.1] + turn @ [0.6 * slide, 0.0, 0.8 * slide]
        found = rim.tool([around, tilt, slide])
        np.testing.assert_allclose(found, pin.SE3(turn, at), rtol=0.0, atol=1e-12)
