"""Signed distances of convex shapes from their support functions alone, to check those of coal.

For disjoint and for overlapping convex shapes alike, the signed distance is the largest gap
between them over all directions n, -h_A(n) - h_B(-n) with their support functions h: the width of
the widest slab that separates them, or minus the length of the shortest translation that does.
See Boyd and Vandenberghe, Convex Optimization, section 8.2, and Cameron and Culley, Determining the
minimum translational distance between two convex polyhedra (ICRA 1986).
"""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats

__all__ = ["compute_gaps", "find_widest_gap"]

_DIRECTIONS = 4000
_STARTS = 5  # best directions that are improved
_NEIGHBOURS = 24  # directions tried around one
_ROUNDS = 80


def compute_support(shape: coal.CollisionGeometry, directions: Floats) -> Floats:
    """Return the support function of a shape in its own frame, shape (n,) [m].

    Args:
        shape: A convex shape of coal.
        directions: Unit vectors, shape (n, 3).
    """
    radial = np.hypot(directions[:, 0], directions[:, 1])
    axial = np.abs(directions[:, 2])
    match shape:
        case coal.Box():
            found = np.abs(directions) @ shape.halfSide
        case coal.Sphere():
            found = np.full(len(directions), shape.radius)
        case coal.Ellipsoid():
            found = np.linalg.norm(directions * shape.radii, axis=1)
        case coal.Capsule():
            found = shape.radius + shape.halfLength * axial
        case coal.Cylinder():
            found = shape.radius * radial + shape.halfLength * axial
        case coal.Cone():
            rim = shape.radius * radial - shape.halfLength * directions[:, 2]
            found = np.maximum(rim, shape.halfLength * directions[:, 2])
        case coal.Convex():
            found = (directions @ np.asarray(shape.points()).T).max(axis=1)
        case _:
            raise TypeError(f"no support function of {type(shape).__name__}")
    return np.asarray(found + shape.getSweptSphereRadius())


def compute_gaps(
    first: coal.CollisionGeometry,
    first_placement: pin.SE3,
    second: coal.CollisionGeometry,
    second_placement: pin.SE3,
    directions: Floats,
) -> Floats:
    """Return the gap between two shapes along each direction, shape (n,) [m].

    Args:
        first, second: Convex shapes of coal.
        first_placement, second_placement: Their placements in a common frame.
        directions: Unit vectors from the first towards the second, shape (n, 3).
    """
    between = second_placement.translation - first_placement.translation
    ends = compute_support(first, directions @ first_placement.rotation)
    ends = ends + compute_support(second, -directions @ second_placement.rotation)
    return np.asarray(directions @ between - ends)


def find_widest_gap(
    first: coal.CollisionGeometry,
    first_placement: pin.SE3,
    second: coal.CollisionGeometry,
    second_placement: pin.SE3,
) -> float:
    """Return the widest gap of two convex shapes that a search finds [m].

    Directions all over the sphere are tried, with those of symmetry; the best ones are improved. As
    any gap, it is at most the signed distance; a distance is right that is one, and below none.
    """
    pair = first, first_placement, second, second_placement
    axes = np.vstack([first_placement.rotation.T, second_placement.rotation.T])
    special = np.vstack([axes, np.cross(axes[:3, None], axes[None, 3:]).reshape(-1, 3)])
    spread = _spread(_DIRECTIONS)
    between = second_placement.translation - first_placement.translation
    directions = _normalize(np.vstack([spread, special, -special, between, -between]))
    gaps = compute_gaps(*pair, directions)
    rng = np.random.default_rng(0)
    best = -np.inf
    for direction in directions[np.argsort(-gaps)[:_STARTS]]:
        here = direction
        gap = float(compute_gaps(*pair, direction[None])[0])
        radius = 0.05
        for _ in range(_ROUNDS):
            near = _normalize(here + radius * rng.normal(size=(_NEIGHBOURS, 3)))
            found = compute_gaps(*pair, near)
            if found.max() > gap:
                here = near[int(found.argmax())]
                gap = float(found.max())
            else:
                radius *= 0.7
        best = max(best, gap)
    return best


def _normalize(vectors: Floats) -> Floats:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors[lengths[:, 0] > 1e-9] / lengths[lengths[:, 0] > 1e-9])


def _spread(count: int) -> Floats:
    """Return directions evenly spread over the sphere, a spiral by the golden angle."""
    height = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angle = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    ring = np.sqrt(1.0 - height**2)
    return np.column_stack([ring * np.cos(angle), ring * np.sin(angle), height])
