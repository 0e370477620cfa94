"""Tests bounds of displacements against the paths of the corners of the shapes' boxes."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.motions import make_random_stick_motion
from helpers.small_problems import make_full_scene
from helpers.telescopes import write_coupled_scene

from vkc_pin.validation.distances import CollisionShapes, bound_displacements
from vkc_pin.validation.samples import Samples
from vkc_pin.world.trajectory.world_model import World


def measure_paths(world: World, z: np.ndarray, count: int) -> np.ndarray:
    """Return the longest path of a corner of each shape, shape (S − 1, G)."""
    data, shapes = world.model.createData(), pin.GeometryData(world.collision)
    corners = []
    for shape in world.shapes:
        shape.geometry.computeLocalAABB()
        box = shape.geometry.aabb_local
        corners.append(np.array(list(itertools.product(*zip(box.min_, box.max_, strict=True)))))
    found = []
    for begin, end in itertools.pairwise(z):
        places = []
        for share in np.linspace(0.0, 1.0, count):
            q = world.coordinates.q((1 - share) * begin + share * end)
            pin.updateGeometryPlacements(world.model, data, world.collision, shapes, q)
            both = zip(corners, shapes.oMg, strict=True)
            places.append([p @ at.rotation.T + at.translation for p, at in both])
        steps = np.linalg.norm(np.diff(np.array(places), axis=0), axis=-1)
        found.append(steps.max(axis=-1).sum(axis=0))
    return np.array(found)


@pytest.mark.parametrize("size", [0.1, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_bounds_hold_for_revolute_and_prismatic_joints(seed: int, size: float) -> None:
    world, rng = World(make_full_scene()), np.random.default_rng(seed)
    z = rng.uniform(-1.0, 1.0, (1, world.coordinates.size)) + size * rng.uniform(
        -1.0, 1.0, (4, world.coordinates.size)
    ) * rng.choice([0.0, 1.0], world.coordinates.size)
    bounds = np.diff(bound_displacements(CollisionShapes(world), z), axis=0)
    paths = measure_paths(world, z, 60)
    assert (paths <= bounds + 1e-9).all()
    assert (bounds[paths == 0.0] == 0.0).all()


@pytest.mark.parametrize("seed", range(3))
def test_bounds_hold_for_coupled_joints(seed: int, tmp_path: Path) -> None:
    world, rng = World(write_coupled_scene(tmp_path)), np.random.default_rng(seed)
    low, high = (
        np.nan_to_num(bound, posinf=1.0, neginf=-1.0)
        for bound in (world.coordinates.lower, world.coordinates.upper)
    )
    z = rng.uniform(low, high, (4, world.coordinates.size))
    z[:, :2] = rng.uniform(-1.0, 1.0, (4, 2))
    bounds = np.diff(bound_displacements(CollisionShapes(world), z), axis=0)
    assert (measure_paths(world, z, 100) <= bounds + 1e-9).all()


@pytest.mark.parametrize("size", [0.1, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_bounds_hold_for_grasped_objects(seed: int, size: float) -> None:
    scene, motion = make_random_stick_motion(seed, size=size)
    samples = Samples(scene, motion)
    world = samples.world
    bounds = np.diff(bound_displacements(CollisionShapes(world), samples.z), axis=0)
    paths = measure_paths(world, samples.z, 4)
    assert (paths <= bounds + 1e-6).all()
    labels = np.array([label.partition(".")[0] for label in world.collision_labels])
    carried = np.isin(labels, ("stick", "ball"))
    assert carried.sum() == 6
    assert (bounds[:, carried] <= 100 * paths[:, carried] + 1e-6).all()
    assert paths[:, carried].max() > 0.0
