"""Tests that random furniture is valid in all sizes, reproducible, and written to files."""

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
FEW_EXAMPLES = settings(max_examples=10, deadline=None, phases=[Phase.generate])
ANY_KIND = st.sampled_from(sorted(KINDS))


def place_object(kind: str, seed: int) -> vkc.PlacedObject:
    loaded = vkc.load_object(vkc.procedural.random_object(kind, seed))
    return vkc.PlacedObject(
        kind, loaded, pin.SE3.Identity(), np.clip(0.0, loaded.lower, loaded.upper)
    )


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
        (shape.geometry, tool.actInv(placement))
        for shape, placement in found
        if shape.name.startswith(names)
    ]


HAND_SHAPES = get_hand_shapes()


@FEW_EXAMPLES
@given(ANY_KIND, st.integers(0, 5000))
def test_hand_fits_around_every_handle(kind: str, seed: int) -> None:
    """Open fingers keep the planner's clearances: 5 mm to the grasped link, 20 mm to others."""
    placed = place_object(kind, seed)
    assert len(placed.object.attachments) >= 2
    for attachment in placed.object.attachments.values():
        tool = placed.link_placement(attachment.link) * attachment.tool(
            np.zeros(len(attachment.freedoms))
        )
        for shape in make_world_shapes(placed):
            link = shape.name.rpartition("_")[0]
            least = min(
                compute_shape_distance(solid, tool * placement, shape.geometry, shape.placement)
                for solid, placement in HAND_SHAPES
            )
            assert least >= (0.005 if link == attachment.link else 0.02), (
                attachment.name,
                shape.name,
                least,
            )


@FEW_EXAMPLES
@given(ANY_KIND, st.integers(0, 5000))
def test_moving_links_do_not_collide(kind: str, seed: int) -> None:
    """No link penetrates the base or another link while one joint moves over its range."""
    placed = place_object(kind, seed)
    model = placed.object.model
    for k, joint in enumerate(placed.object.coordinates.names):
        if model.parents[model.getJointId(joint)] != 0:
            continue  # the spindle of a door lever is in the panel
        for value in np.linspace(placed.object.lower[k], placed.object.upper[k], 7):
            shapes = make_world_shapes(placed.with_state({joint: value}))
            parents = [shape.parentJoint for shape in placed.object.collision.geometryObjects]
            moved = placed.object.links_moved_by({joint})
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


@FEW_EXAMPLES
@given(ANY_KIND, st.integers(0, 5000))
def test_doors_open_towards_the_user(kind: str, seed: int) -> None:
    placed = place_object(kind, seed)
    for attachment in placed.object.attachments.values():
        joint = (
            placed.object.coordinates.names[0]
            if kind == "door"
            else next(
                str(placed.object.model.names[frame.parentJoint])
                for frame in placed.object.model.frames
                if frame.name == attachment.link
            )
        )
        before, after = (
            (
                placed.with_state({joint: value}).link_placement(attachment.link)
                * attachment.placement
            ).translation
            for value in (0.0, 0.3 * placed.object.upper[placed.object.coordinates.index(joint)])
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
    description = vkc.procedural.random_object("refrigerator", 5)
    file = vkc.procedural.write_object(description, tmp_path / "new" / "thing.yaml")
    assert sorted(path.name for path in file.parent.iterdir()) == ["thing.urdf", "thing.yaml"]
    loaded, expected = vkc.load_object(file), vkc.load_object(description)
    assert (loaded.name, loaded.urdf) == ("thing", tmp_path / "new" / "thing.urdf")
    assert loaded.model == expected.model
    assert list(loaded.attachments) == list(expected.attachments)
    np.testing.assert_array_equal(loaded.acceleration, expected.acceleration)


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
