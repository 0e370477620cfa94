"""Makes scenes for a mobile base, and computes its clearance by coal without culling."""

from __future__ import annotations

from collections.abc import Sequence

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin.planning.base_paths.base_clearance import Shape
from vkc_pin.world.files.meshes import make_convex_hull

HALL = (-5.0, 5.0, -5.0, 5.0)
MARGIN = 0.02
# tolerated shortfall of the margin between two checked poses, with rounding [m]
MARGIN_TOLERANCE = 1.1e-3


def make_pose(x: float, y: float, z: float, yaw: float = 0.0) -> pin.SE3:
    return pin.SE3(pin.utils.rotate("z", yaw), np.array([x, y, z], float))


def make_chassis(length: float = 1.0, width: float = 0.67) -> list[Shape]:
    return [(coal.Box(length, width, 0.4), make_pose(0.0, 0.0, 0.2))]


def make_arm_shapes() -> list[Shape]:
    """Return ten convex shapes 0.4 to 1.1 m above the floor that overhang the chassis a little."""
    rng = np.random.default_rng(1)
    shapes = []
    for k in range(10):
        x, y, z = rng.uniform([-0.2, -0.3, 0.5], [0.5, 0.3, 1.0])
        placement = pin.SE3(pin.utils.rotate("y", rng.uniform(0.0, np.pi)), np.array([x, y, z]))
        shapes.append((coal.Capsule(0.05, 0.25) if k % 2 else coal.Box(0.1, 0.1, 0.3), placement))
    return shapes


def make_wedge() -> coal.Convex:
    """Return a convex mesh: a prism with a triangle as its base, lower at one end."""
    return make_convex_hull(
        [(0, 0, 0), (0.6, 0, 0), (0, 0.4, 0), (0, 0, 0.5), (0.6, 0, 0.2), (0, 0.4, 0.5)]
    )


def make_furniture() -> list[Shape]:
    """Return a table, a table top on four legs, and a block in front of them."""
    legs = [
        (coal.Box(0.08, 0.08, 0.75), make_pose(-0.5 + 1.4 * a, 3.5 + 0.7 * b, 0.375))
        for a in (-1, 1)
        for b in (-1, 1)
    ]
    return [
        (coal.Box(1.0, 2.0, 0.72), make_pose(2.5, 1.0, 0.36)),
        (coal.Box(3.0, 1.6, 0.05), make_pose(-0.5, 3.5, 0.775)),
        (coal.Box(2.0, 3.0, 2.1), make_pose(2.0, -2.0, 1.05)),
        *legs,
    ]


def make_clutter(seed: int, count: int, *, reach: float = 4.5) -> list[Shape]:
    """Return random boxes, cylinders, spheres and lying capsules."""
    rng = np.random.default_rng(seed)
    shapes: list[Shape] = []
    for k in range(count):
        x, y = rng.uniform(-reach, reach, 2)
        height = rng.uniform(0.2, 2.0)
        yaw = rng.uniform(0.0, np.pi)
        if k % 4 == 0:
            shapes.append(
                (coal.Box(*rng.uniform(0.1, 0.8, 2), height), make_pose(x, y, height / 2, yaw))
            )
        elif k % 4 == 1:
            shapes.append(
                (coal.Cylinder(rng.uniform(0.05, 0.3), height), make_pose(x, y, height / 2))
            )
        elif k % 4 == 2:
            shapes.append(
                (coal.Sphere(rng.uniform(0.1, 0.4)), make_pose(x, y, rng.uniform(0.2, 1.0)))
            )
        else:
            lying = pin.SE3(
                pin.utils.rotate("z", yaw) @ pin.utils.rotate("x", np.pi / 2 - 0.2),
                np.array([x, y, 0.6]),
            )
            shapes.append((coal.Capsule(0.06, rng.uniform(0.2, 0.8)), lying))
    return shapes


def compute_distance(
    shapes: Sequence[Shape], standing: Sequence[Shape], pose: Sequence[float]
) -> float:
    """Return coal's smallest distance of a base at (x, y, yaw) to fixed shapes [m]."""
    base = make_pose(pose[0], pose[1], 0.0, pose[2])
    nearest = np.inf
    for shape, placement in shapes:
        transform = _transform(base * placement)
        for other, other_placement in standing:
            found = coal.distance(
                shape,
                transform,
                other,
                _transform(other_placement),
                coal.DistanceRequest(),
                coal.DistanceResult(),
            )
            nearest = min(nearest, found)
    return nearest


def interpolate_poses(
    a: Sequence[float], b: Sequence[float], *, length: float = 0.01, angle: float = 0.02
) -> NDArray[np.float64]:
    """Return poses from `a` to `b`, at most `length` [m] and `angle` [rad] apart, shape (N, 3)."""
    change = np.subtract(b, a)
    count = 2 + int(max(np.hypot(change[0], change[1]) / length, abs(change[2]) / angle))
    return np.linspace(a, b, count)


def _transform(placement: pin.SE3) -> coal.Transform3s:
    return coal.Transform3s(placement.rotation, placement.translation)
