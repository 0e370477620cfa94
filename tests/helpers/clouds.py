"""Samples the surfaces of a scene's obstacles, as a depth camera would measure them."""

from __future__ import annotations

import numpy as np

import vkc_pin as vkc
from vkc_pin.world.models.shapes import triangulate
from vkc_pin.world.scene.obstacles import FLOOR

NOISE = 1.5e-3  # [1/m] of depth cameras: the error in [m] is about this times the square of depth
LARGEST_DEPTH = 3.0  # [m]


def sample_obstacles(scene: vkc.Scene, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return points on all obstacles but the floor, with the noise of the nearest of 3 cameras."""
    triangles = []
    for shape, label in zip(scene.obstacles, scene.obstacle_labels, strict=True):
        if label != FLOOR:
            vertices, faces = triangulate(shape.geometry)
            world = vertices @ shape.placement.rotation.T + shape.placement.translation
            triangles.append(world[faces])
    corners = np.concatenate(triangles)
    first = corners[:, 1] - corners[:, 0]
    second = corners[:, 2] - corners[:, 0]
    areas = np.linalg.norm(np.cross(first, second), axis=1)
    chosen = rng.choice(len(corners), count, p=areas / areas.sum())
    weights = rng.random((count, 2))
    is_outside = weights.sum(axis=1) > 1.0
    weights[is_outside] = 1.0 - weights[is_outside]
    points = corners[chosen, 0]
    points = points + weights[:, :1] * first[chosen] + weights[:, 1:] * second[chosen]

    x_min, x_max, y_min, y_max = scene.arena
    fractions = np.array([0.3, 0.5, 0.7])[:, None]
    ends = np.array([[x_min, y_min, 1.5], [x_max, y_max, 1.5]])
    cameras = ends[0] + fractions * (ends[1] - ends[0])
    offsets = points[:, None] - cameras
    depths = np.linalg.norm(offsets, axis=2)
    nearest = depths.argmin(axis=1)
    rows = np.arange(count)
    depth = depths[rows, nearest]
    rays = offsets[rows, nearest] / depth[:, None]
    spread = NOISE * np.minimum(depth, LARGEST_DEPTH) ** 2
    return np.asarray(points + rays * (rng.normal(size=count) * spread)[:, None])


def replace_obstacles(scene: vkc.Scene, count: int, seed: int = 2) -> vkc.Scene:
    """Return the scene with points of its obstacles instead of these."""
    document = scene.document
    document["obstacles"] = []
    bare = vkc.Scene.from_document(document, scene.folder)
    return bare.with_points(sample_obstacles(scene, count, np.random.default_rng(seed)))
