"""Tests that random furniture is valid in all sizes, reproducible, and written to files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.robots import compute_placement, get_home_configuration
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
    start, geometry = get_home_configuration(ROBOT), ROBOT.collision
    data, shapes = ROBOT.model.createData(), geometry.createData()
    q = ROBOT.coordinates.q(start)
    pin.updateGeometryPlacements(ROBOT.model, data, geometry, shapes, q)
    tool = compute_placement(ROBOT, ROBOT.tool_frame, start)
    return [
        (shape.geometry, tool.actInv(placement))
        for shape, placement in zip(geometry.geometryObjects, shapes.oMg, strict=True)
        if shape.name.startswith(("gripper", "wrist_3"))
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
            own = shape.name.rpartition("_")[0] == attachment.link
            least = min(
                compute_shape_distance(solid, tool * placement, shape.geometry, shape.placement)
                for solid, placement in HAND_SHAPES
            )
            assert least >= (0.005 if own else 0.02), (attachment.name, shape.name, least)


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
            moved = placed.object.links_moved_by({joint})
            groups: dict[bool, list] = {True: [], False: []}
            for shape in shapes:
                groups[shape.name.rpartition("_")[0] in moved].append(shape)
            least = 0.0 if kind in ("faucet", "valve") else 5e-4  # levers sit on their spindles
            clearance = compute_clearance(*map(list_placed_shapes, groups.values()), reach=0.01)
            assert clearance >= least - 1e-6, (joint, value)


@FEW_EXAMPLES
@given(ANY_KIND, st.integers(0, 5000))
def test_doors_open_towards_the_user(kind: str, seed: int) -> None:
    placed = place_object(kind, seed)
    model = placed.object.model
    for attachment in placed.object.attachments.values():
        frame = next(each for each in model.frames if each.name == attachment.link)
        joint = placed.object.coordinates.names[0] if kind == "door" else ""
        joint = joint or str(model.names[frame.parentJoint])
        most = placed.object.upper[placed.object.coordinates.index(joint)]
        before, after = (
            placed.with_state({joint: value})
            .link_placement(attachment.link)
            .act(attachment.placement.translation)
            for value in (0.0, 0.3 * most)
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
    oven = vkc.procedural.random_object("oven")
    with pytest.raises(vkc.InputError, match=r"ends with \.yaml"):
        vkc.procedural.write_object(oven, tmp_path / "oven.urdf")
    with pytest.raises(vkc.InputError, match="attachments"):
        vkc.procedural.write_object({"urdf": oven["urdf"]}, tmp_path / "oven.yaml")
    assert not list(tmp_path.iterdir())
