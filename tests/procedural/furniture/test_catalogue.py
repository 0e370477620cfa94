"""Tests random furniture: valid for all sizes, reproducible, and written to files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.procedural.furniture.catalogue import KINDS
from vkc_pin.world.models.shapes import (
    compute_clearance,
    compute_shape_distance,
    list_placed_shapes,
)
from vkc_pin.world.scene.placed_object import make_world_shapes

ROBOT = vkc.load_robot("husky_ur5e")
FEW = settings(max_examples=10, deadline=None, phases=[Phase.generate])
EACH = st.sampled_from(sorted(KINDS))


def place_object(kind: str, seed: int) -> vkc.PlacedObject:
    thing = vkc.load_object(vkc.procedural.random_object(kind, seed))
    return vkc.PlacedObject(kind, thing, pin.SE3.Identity(), np.clip(0.0, thing.lower, thing.upper))


def get_hand_shapes() -> list:
    """Return the shapes of the gripper and the last link of the arm, in the tool's frame."""
    model, data, geometry = ROBOT.model, ROBOT.model.createData(), ROBOT.collision
    shapes = geometry.createData()
    start = ROBOT.coordinates.q(np.concatenate([np.zeros(3), ROBOT.home]))
    pin.updateGeometryPlacements(model, data, geometry, shapes, start)
    pin.framesForwardKinematics(model, data, start)
    tool = data.oMf[model.getFrameId(ROBOT.tool_frame)]
    names = ("gripper", "wrist_3")
    found = zip(geometry.geometryObjects, shapes.oMg, strict=True)
    return [
        (shape.geometry, tool.actInv(where))
        for shape, where in found
        if shape.name.startswith(names)
    ]


HAND = get_hand_shapes()


@FEW
@given(EACH, st.integers(0, 5000))
def test_the_hand_fits_around_every_handle(kind: str, seed: int) -> None:
    """Open fingers keep a plan's clearances: 5 mm to the grasped link, 20 mm to others."""
    own = place_object(kind, seed)
    assert len(own.object.attachments) >= 2
    for attachment in own.object.attachments.values():
        tool = own.link_placement(attachment.link) * attachment.tool(
            np.zeros(len(attachment.freedoms))
        )
        for shape in make_world_shapes(own):
            link = shape.name.rpartition("_")[0]
            least = min(
                compute_shape_distance(solid, tool * where, shape.geometry, shape.placement)
                for solid, where in HAND
            )
            assert least >= (0.005 if link == attachment.link else 0.02), (
                attachment.name,
                shape.name,
                least,
            )


@FEW
@given(EACH, st.integers(0, 5000))
def test_links_pass_each_other(kind: str, seed: int) -> None:
    """One joint at a time, from end to end, no link enters the base or another link."""
    own = place_object(kind, seed)
    model = own.object.model
    for k, joint in enumerate(own.object.coordinates.names):
        if model.parents[model.getJointId(joint)] != 0:
            continue  # a door's lever has its spindle in the panel
        for value in np.linspace(own.object.lower[k], own.object.upper[k], 7):
            shapes = make_world_shapes(own.with_state({joint: value}))
            parents = [shape.parentJoint for shape in own.object.collision.geometryObjects]
            moved = own.object.links_moved_by({joint})
            moving = [s for s in shapes if s.name.rpartition("_")[0] in moved]
            others = [
                s
                for s, parent in zip(shapes, parents, strict=True)
                if s.name.rpartition("_")[0] not in moved
            ]
            least = 0.0 if kind in ("faucet", "valve") else 5e-4  # levers sit on their spindles
            assert (
                compute_clearance(
                    list_placed_shapes(moving), list_placed_shapes(others), reach=0.01
                )
                >= least - 1e-6
            ), (joint, value, parents)


@FEW
@given(EACH, st.integers(0, 5000))
def test_doors_open_towards_the_user(kind: str, seed: int) -> None:
    own = place_object(kind, seed)
    for attachment in own.object.attachments.values():
        joint = (
            own.object.coordinates.names[0]
            if kind == "door"
            else next(
                str(own.object.model.names[frame.parentJoint])
                for frame in own.object.model.frames
                if frame.name == attachment.link
            )
        )
        before, after = (
            (
                own.with_state({joint: value}).link_placement(attachment.link)
                * attachment.placement
            ).translation
            for value in (0.0, 0.3 * own.object.upper[own.object.coordinates.index(joint)])
        )
        moved = after - before
        if kind in ("dishwasher", "oven"):
            assert moved[2] < -0.02
        elif kind == "chest":
            assert moved[2] > 0.02
        elif kind not in ("door", "faucet", "valve"):
            assert moved[0] < -0.02
        assert np.linalg.norm(moved) > 0.02


def test_random_objects_are_reproducible() -> None:
    for kind in KINDS:
        one, same, other = (vkc.procedural.random_object(kind, seed) for seed in (3, 3, 4))
        assert one == same != other


def test_objects_are_written_to_files(tmp_path: Path) -> None:
    made = vkc.procedural.random_object("refrigerator", 5)
    file = vkc.procedural.write_object(made, tmp_path / "new" / "thing.yaml")
    assert sorted(path.name for path in file.parent.iterdir()) == ["thing.urdf", "thing.yaml"]
    kept, described = vkc.load_object(file), vkc.load_object(made)
    assert (kept.name, kept.urdf) == ("thing", tmp_path / "new" / "thing.urdf")
    assert kept.model == described.model
    assert list(kept.attachments) == list(described.attachments)
    np.testing.assert_array_equal(kept.acceleration, described.acceleration)


def test_invalid_arguments_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(vkc.UnknownNameError, match="did you mean 'refrigerator'"):
        vkc.procedural.random_object("refigerator")
    with pytest.raises(vkc.InputError, match="whole number"):
        vkc.procedural.random_object("oven", -1)
    with pytest.raises(vkc.InputError, match=r"ends with \.yaml"):
        vkc.procedural.write_object(vkc.procedural.random_object("oven"), tmp_path / "oven.urdf")
    with pytest.raises(vkc.InputError, match="attachments"):
        vkc.procedural.write_object(
            {"urdf": vkc.procedural.random_object("oven")["urdf"]}, tmp_path / "oven.yaml"
        )
    assert not list(tmp_path.iterdir())
