"""How far shapes move at most, against the paths of the corners of their boxes."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.motions import wander, whirl
from helpers.small_problems import door_scene, full_scene
from helpers.telescopes import coupled_scene
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.validation.distances import CollisionShapes, bound_displacements
from vkc_pin.validation.pairs import PairTable
from vkc_pin.validation.samples import Samples
from vkc_pin.world.trajectory.world_model import World


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.1, 1.0]))
def test_no_point_moves_further_than_the_bound(seed: int, size: float) -> None:
    """Turning joints, sliding ones, far out too, and one on the other: the room has a drawer and a cabinet as well."""
    scene, rng = full_scene(), np.random.default_rng(seed)
    motion = wander(door_scene(), seed, size=size)
    world = World(scene)
    table = PairTable(scene, CollisionShapes(world), motion, 0.02)
    z = world.compute_positions(motion)
    z[:, 11:] += rng.uniform(0.0, 2.0, z.shape[1] - 11)
    z[1:, 11:] += size * rng.uniform(-1.0, 1.0, (len(z) - 1, z.shape[1] - 11))
    bounds = np.diff(bound_displacements(table.solids, z), axis=0)
    data, shapes = world.model.createData(), pin.GeometryData(world.collision)
    corners = [np.array(box_corners(shape)) for shape in world.shapes]
    for t in range(len(z) - 1):
        path = np.zeros(len(corners))
        before: list[np.ndarray] = []
        for share in np.linspace(
            0.0, 1.0, 60
        ):  # the way of each corner of the bounding boxes, not only its ends
            q = world.coordinates.q((1 - share) * z[t] + share * z[t + 1])
            pin.updateGeometryPlacements(world.model, data, world.collision, shapes, q)
            now = [
                points @ where.rotation.T + where.translation
                for points, where in zip(corners, shapes.oMg, strict=True)
            ]
            if before:
                path += [
                    np.linalg.norm(a - b, axis=1).max() for a, b in zip(now, before, strict=True)
                ]
            before = now
        assert (path <= bounds[t] + 1e-9).all()
        assert (bounds[t][path == 0] == 0).all()


@pytest.mark.parametrize("seed", range(6))
def test_no_point_of_a_robot_whose_joints_follow_others_moves_further(
    seed: int, tmp_path: Path
) -> None:
    world, rng = World(coupled_scene(tmp_path)), np.random.default_rng(seed)
    low, high = (
        np.nan_to_num(bound, posinf=1.0, neginf=-1.0)
        for bound in (world.coordinates.lower, world.coordinates.upper)
    )
    z = rng.uniform(low, high, (4, world.coordinates.size))
    z[:, :2] = rng.uniform(-1.0, 1.0, (4, 2))
    bounds = np.diff(bound_displacements(CollisionShapes(world), z), axis=0)
    data, shapes = world.model.createData(), pin.GeometryData(world.collision)
    corners = [np.array(box_corners(shape)) for shape in world.shapes]
    for t in range(len(z) - 1):
        places = []
        for share in np.linspace(0.0, 1.0, 100):
            q = world.coordinates.q((1 - share) * z[t] + share * z[t + 1])
            pin.updateGeometryPlacements(world.model, data, world.collision, shapes, q)
            places.append(
                [
                    p @ where.rotation.T + where.translation
                    for p, where in zip(corners, shapes.oMg, strict=True)
                ]
            )
        steps = np.linalg.norm(np.diff(np.array(places), axis=0), axis=-1)
        assert (steps.max(axis=-1).sum(axis=0) <= bounds[t] + 1e-9).all()


def box_corners(shape: pin.GeometryObject) -> list[list[float]]:
    shape.geometry.computeLocalAABB()
    box = shape.geometry.aabb_local
    return [
        [x, y, z]
        for x in (box.min_[0], box.max_[0])
        for y in (box.min_[1], box.max_[1])
        for z in (box.min_[2], box.max_[2])
    ]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.1, 1.0, 3.0]))
def test_no_point_of_what_is_carried_moves_further_than_the_bound(seed: int, size: float) -> None:
    scene, motion = whirl(seed, size=size)
    samples = Samples(scene, motion)
    table_of_pairs = PairTable(scene, CollisionShapes(samples.world), motion, 0.02)
    bounds = np.diff(
        bound_displacements(table_of_pairs.solids, samples.z)[samples.waypoint_rows], axis=0
    )
    world = samples.world
    data, shapes = world.model.createData(), pin.GeometryData(world.collision)
    corners = [np.array(box_corners(shape)) for shape in world.shapes]
    carried = [
        i
        for i, label in enumerate(world.collision_labels)
        if label.partition(".")[0] in ("stick", "ball")
    ]
    assert len(carried) == 6
    total = 0.0
    for t, (first, last) in enumerate(itertools.pairwise(samples.waypoint_rows)):
        path = np.zeros(len(corners))
        before: list[np.ndarray] = []
        for row in np.linspace(
            first, last, 4 * (last - first) + 1
        ):  # the way of each corner, between the samples too
            low, share = int(row), row - int(row)
            z = (
                samples.z[low]
                if not share
                else (1 - share) * samples.z[low] + share * samples.z[low + 1]
            )
            pin.updateGeometryPlacements(
                world.model, data, world.collision, shapes, world.coordinates.q(z)
            )
            now = [
                points @ where.rotation.T + where.translation
                for points, where in zip(corners, shapes.oMg, strict=True)
            ]
            if before:
                path += [
                    np.linalg.norm(a - b, axis=1).max() for a, b in zip(now, before, strict=True)
                ]
            before = now
        assert (path <= bounds[t] + 1e-6).all()
        assert (bounds[t][path == 0] <= 1e-6).all()
        total += path[carried].max()
        for i in carried:  # and it is no idle bound
            assert bounds[t][i] <= 100 * path[i] + 1e-6
    assert total > 0.0 or np.ptp(motion.positions, axis=0).max() == 0.0
