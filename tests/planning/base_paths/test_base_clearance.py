"""Compares clearance checks of a moving base with coal."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
import pytest
from helpers.base_scenes import (
    MARGIN,
    MARGIN_TOLERANCE,
    compute_distance,
    interpolate_poses,
    make_arm_shapes,
    make_chassis,
    make_clutter,
    make_pose,
    make_wedge,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.planning.base_paths.base_clearance import (
    DIRECTIONS,
    MovingShapes,
    Obstacles,
    Shape,
    compute_hull_points,
)

SEEDS = st.integers(0, 2**32 - 1)


def make_random_scene(seed: int) -> tuple[list[Shape], list[Shape], MovingShapes]:
    """Return random shapes on the base, obstacles, and the moving shapes."""
    rng = np.random.default_rng(seed)
    shapes = [
        *make_chassis(),
        *make_arm_shapes()[:3],
        (make_wedge(), make_pose(0.3, -0.1, 0.6, 0.4)),
    ]
    obstacles = [
        *make_clutter(int(rng.integers(1000)), 8, reach=1.5),
        (make_wedge(), make_pose(*rng.uniform(-1.5, 1.5, 2), 0.3, 1.0)),
    ]
    return shapes, obstacles, MovingShapes(shapes, Obstacles(obstacles), MARGIN)


def test_drives_and_turns_agree_with_coal() -> None:
    answers = []
    for seed in range(12):
        shapes, obstacles, body = make_random_scene(seed)
        rng = np.random.default_rng(seed + 1)
        a, yaw = rng.uniform(-2.0, 2.0, 2), rng.uniform(-4.0, 4.0)
        b, end = a + rng.uniform(-1.0, 1.0, 2), yaw + rng.uniform(-2.0, 2.0) * rng.uniform()
        for is_free, poses in (
            (body.is_drive_free(a, b, yaw), interpolate_poses([*a, yaw], [*b, yaw], length=0.004)),
            (body.is_turn_free(a, yaw, end), interpolate_poses([*a, yaw], [*a, end], angle=0.004)),
        ):
            nearest = min(compute_distance(shapes, obstacles, pose) for pose in poses)
            assert nearest >= MARGIN - MARGIN_TOLERANCE if is_free else nearest < MARGIN + 0.004
            answers.append(is_free)
    assert 0.2 < np.mean(answers) < 0.8


def test_exit_margins_keep_the_initial_distance() -> None:
    boxes = [
        (coal.Box(1.0, 1.0, 1.0), make_pose(x, y, 0.5))
        for x, y in ((1.01, 0.0), (0.0, 0.845), (-3.0, 0.0))
    ]
    body = MovingShapes(make_chassis(), Obstacles(boxes), MARGIN)
    margins = body.compute_exit_margins(np.zeros(2), 0.0)
    assert margins == pytest.approx([0.01, 0.01, MARGIN], abs=1e-5)
    away, towards = np.array([-1.0, 0.0]), np.array([0.005, 0.0])
    assert body.is_drive_free(np.zeros(2), away, 0.0, margins)
    assert not body.is_drive_free(np.zeros(2), away, 0.0)
    assert not body.is_drive_free(np.zeros(2), towards, 0.0, margins)
    inside = body.compute_exit_margins(np.array([0.2, 0.0]), 0.0)
    assert inside[0] == -np.inf


SHAPES = [
    coal.Box(0.3, 0.5, 0.9),
    coal.Sphere(0.4),
    coal.Cylinder(0.3, 0.8),
    coal.Capsule(0.2, 0.6),
    coal.Cone(0.3, 0.7),
    coal.Ellipsoid(0.2, 0.3, 0.5),
    make_wedge(),
]


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
@settings(max_examples=6, deadline=None)
@given(seed=SEEDS)
def test_hull_points_bound_shapes_from_inside_and_outside(
    shape: coal.CollisionGeometry, seed: int
) -> None:
    """Along any direction, coal's support is between the inner and the outer points."""
    rng = np.random.default_rng(seed)
    placement = pin.SE3(
        pin.Quaternion(rng.normal(size=4)).normalized().matrix(), rng.uniform(-1.0, 1.0, 3)
    )
    where = coal.Transform3s(placement.rotation, placement.translation)
    (inner, nothing), (outer, radius) = (
        compute_hull_points(shape, placement, outer=side) for side in (False, True)
    )
    assert nothing == 0.0
    for u in DIRECTIONS[:: int(rng.integers(1, 8))]:
        normal = np.array([*u, 0.0])
        wall = coal.Halfspace(-normal, -10.0)
        gap = coal.distance(
            shape, where, wall, coal.Transform3s(), coal.DistanceRequest(), coal.DistanceResult()
        )
        reach = 10.0 - gap
        assert (outer @ normal).max() + radius >= reach - 1e-6
        if len(inner):
            assert (inner @ normal).max() <= reach + 1e-6
    if not isinstance(shape, coal.Ellipsoid):
        assert len(inner)
