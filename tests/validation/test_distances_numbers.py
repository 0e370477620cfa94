"""Boxes, bounds of distances and how far shapes move, worked out in another way."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.motions import whirl
from helpers.small_problems import full_scene

from vkc_pin.validation.distances import (
    POINT_RADIUS,
    CollisionShapes,
    PlacedShapes,
    _bound_free_displacements,
    bound_displacements,
)
from vkc_pin.validation.samples import Samples
from vkc_pin.world.trajectory.world_model import World


@cache
def solids() -> CollisionShapes:
    return CollisionShapes(World(full_scene()))


def test_boxes_are_those_around_the_corners_of_turned_boxes() -> None:
    """Of what moves and of what stands, no larger than that."""
    mine = solids()
    world, rng = mine.world, np.random.default_rng(3)
    q = world.coordinates.q(rng.uniform(-1.0, 1.0, (2, world.coordinates.size)))
    placed = mine.place(q)
    assert len(placed) == 2
    lower, upper = placed.corners
    assert lower.shape == upper.shape == (2, len(world.shapes), 3)
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    for state in range(2):
        data = pin.GeometryData(world.collision)
        pin.updateGeometryPlacements(
            world.model, world.model.createData(), world.collision, data, q[state]
        )
        for g, where in enumerate(data.oMg):
            corners = (mine.center[g] + signs * mine.half[g]) @ where.rotation.T + where.translation
            np.testing.assert_allclose(lower[state, g], corners.min(axis=0), atol=1e-9)
            np.testing.assert_allclose(upper[state, g], corners.max(axis=0), atol=1e-9)


def between(one: tuple[list[float], list[float]], other: tuple[list[float], list[float]]) -> float:
    """Return the bound for two boxes, in either order."""
    solid: Any = SimpleNamespace()
    placed = PlacedShapes(solid, np.zeros((2, 0, 12)))
    far = ([9.0] * 3, [9.5] * 3)
    corners = tuple(np.array([[far[side], far[side]], [one[side], other[side]]]) for side in (0, 1))
    placed.__dict__["corners"] = corners
    found = placed.compute_lower_bounds(np.array([1, 1]), np.array([[0, 1], [1, 0]]))
    assert found[0] == found[1]
    return float(found[0])


def test_bounds_of_boxes() -> None:
    """Along an edge, across a corner, or none where they overlap."""
    unit = ([0.0, 0.0, 0.0], [1.0, 1.0, 1.0])
    assert between(unit, ([1.25, 0.5, 0.5], [2.0, 2.0, 2.0])) == 0.25
    assert between(unit, ([4.0, 5.0, 0.5], [5.0, 6.0, 2.0])) == 5.0
    assert between(unit, ([-3.0, -5.0, -13.0], [-2.0, -2.0, -5.0])) == pytest.approx(
        np.sqrt(4.0 + 4.0 + 25.0)
    )
    assert between(unit, ([0.5, 0.5, 0.5], [2.0, 2.0, 2.0])) == -np.inf
    assert between(unit, ([0.25, 0.25, 0.25], [0.5, 0.5, 0.5])) == -np.inf
    assert between(unit, ([0.5, 0.5, 1.0 + 1e-9], [2.0, 2.0, 2.0])) == pytest.approx(1e-9, rel=1e-6)


def test_how_far_shapes_move_is_the_sum_over_their_joints() -> None:
    """Of a turn, by the angle times all the offsets from its axis to the far corner; of a slide, by its way."""
    mine = solids()
    world, rng = mine.world, np.random.default_rng(5)
    names, model = world.coordinates.names, world.model
    z = rng.uniform(-1.0, 1.0, (4, world.coordinates.size))
    found = bound_displacements(mine, z)
    assert found.shape == (4, len(world.shapes))
    np.testing.assert_array_equal(found[0], 0.0)
    np.testing.assert_array_equal(found[:, mine.body_count :], 0.0)
    kinds = set()
    for g, shape in enumerate(world.shapes[: mine.body_count]):
        far = np.linalg.norm(mine.half[g]) + np.linalg.norm(shape.placement.act(mine.center[g]))
        joint, expected = shape.parentJoint, np.zeros(4)
        while joint:
            name = model.names[joint]
            if model.joints[joint].shortname() == "JointModelPlanar":
                kinds.add("planar")
                ways = (
                    np.linalg.norm(np.diff(z[:, :2], axis=0), axis=1)
                    + np.abs(np.diff(z[:, 2])) * far
                )
            else:
                column = z[:, names.index(name)]
                ways = np.abs(np.diff(column))
                if world.coordinates.units[names.index(name)] == "m":
                    kinds.add("slides")
                    far += np.abs(column).max()
                else:
                    kinds.add("turns")
                    ways = ways * far
            expected[1:] += np.cumsum(ways)
            far += np.linalg.norm(model.jointPlacements[joint].translation)
            joint = model.parents[joint]
        np.testing.assert_allclose(found[:, g], expected, rtol=1e-9, atol=1e-12)
    assert kinds == {"planar", "slides", "turns"}


@pytest.mark.parametrize("angle", [0.0, 1e-3, 1.0, 3.0])
def test_how_far_a_point_at_a_free_joint_moves(angle: float) -> None:
    """By its way and its turn, of quaternions of any length and either sign."""
    turn = np.array([np.sin(angle / 2), 0.0, 0.0, np.cos(angle / 2)])
    rows = np.array(
        [
            [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0],
            [3.0, 4.0, 0.0, *(-0.5 * turn)],
            [3.0, 4.0, 2.0, *(3.0 * turn)],
        ]
    )
    np.testing.assert_allclose(
        _bound_free_displacements(rows, 0.25), [5.0 + 0.25 * angle, 2.0], atol=1e-7
    )


def test_what_is_carried_moves_as_its_free_joint_does() -> None:
    scene, motion = whirl(1, size=0.5)
    samples = Samples(scene, motion)
    mine, world = CollisionShapes(samples.world), samples.world
    found = bound_displacements(mine, samples.z)
    for g, label in enumerate(world.collision_labels[: mine.body_count]):
        owner = label.partition(".")[0]
        if owner not in ("stick", "ball"):
            continue
        shape = world.shapes[g]
        far = np.linalg.norm(mine.half[g]) + np.linalg.norm(shape.placement.act(mine.center[g]))
        columns = world.get_placement_columns(owner)
        expected = np.append(
            0.0, np.cumsum(_bound_free_displacements(samples.z[:, columns], float(far)))
        )
        np.testing.assert_allclose(found[:, g], expected, atol=1e-6)


def test_a_point_has_a_size() -> None:
    """A tenth of a millimetre: what is that much further away is still near, what is more is not."""
    assert POINT_RADIUS == 1e-4  # [m]
    mine = solids()
    placed = mine.place(mine.world.coordinates.q(np.zeros((1, mine.world.coordinates.size))))
    wall = next(
        k
        for k in range(mine.body_count, len(mine.world.shapes))
        if "wall" in mine.world.collision_labels[k]
    )
    lower, upper = (corners[0, wall] for corners in placed.corners)
    for axis in range(3):
        for edge, side in ((lower, -1.0), (upper, 1.0)):
            for gap, near in ((0.5 * POINT_RADIUS, True), (1.5 * POINT_RADIUS, False)):
                point = (lower + upper) / 2
                point[axis] = edge[axis] + side * (0.25 + gap)
                assert (wall in placed.find_shapes_near(point, 0.25)) == near
