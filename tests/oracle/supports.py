"""Finds free objects that rest on moving links and move with them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import coal
import numpy as np

from .poses import Poses, make_pose
from .urdf import Points

if TYPE_CHECKING:
    from .stage import World

__all__ = ["compute_distance", "find_supports", "rests_on"]

DROP = 5e-3  # [m] by which an object is lowered to find its support
SUPPORT = 2.5e-3  # [m] least overlap with the support after lowering

_REQUEST, _RESULT = coal.DistanceRequest(), coal.DistanceResult()


def compute_distance(one: object, here: Poses, other: object, there: Poses, k: int = 0) -> float:
    """Return the signed distance between two shapes at sample k [m]."""
    i, j = (0 if len(place.rotation) == 1 else k for place in (here, there))
    a = coal.Transform3s(here.rotation[i], here.translation[i])
    b = coal.Transform3s(there.rotation[j], there.translation[j])
    if isinstance(other, Points):
        return _compute_distance_to_points(one, a, other, b)
    if isinstance(one, Points):
        return _compute_distance_to_points(other, b, one, a)
    _RESULT.clear()
    return float(coal.distance(one, a, other, b, _REQUEST, _RESULT))


def _compute_distance_to_points(
    one: Any, here: coal.Transform3s, other: Points, there: coal.Transform3s
) -> float:
    """Return the smallest distance to the ball of a point; those beyond its box are left out."""
    one.computeLocalAABB()
    low, high = one.aabb_local.min_, one.aabb_local.max_
    world = other.points @ there.getRotation().T + there.getTranslation()
    points = (world - here.getTranslation()) @ here.getRotation()
    excess = np.maximum(np.maximum(low - points, points - high), 0.0)
    bounds = np.linalg.norm(excess, axis=1) - other.radius
    ball, smallest = coal.Sphere(other.radius), np.inf
    for k in np.argsort(bounds):
        if bounds[k] >= smallest:
            break
        _RESULT.clear()
        where = coal.Transform3s(np.eye(3), points[k])
        distance = coal.distance(one, coal.Transform3s(), ball, where, _REQUEST, _RESULT)
        smallest = min(smallest, distance)
    return float(smallest)


def rests_on(
    world: World, links: dict[tuple[str, str], Poses], name: str, support: tuple[str, str]
) -> bool:
    """Return whether an object overlaps a link by over 2.5 mm if lowered by 5 mm, not if raised."""
    ours = world.objects[name].tree.urdf.shapes
    theirs = [
        shape for shape in world.objects[support[0]].tree.urdf.shapes if shape.link == support[1]
    ]

    def compute_overlap(height: float) -> float:
        moved, there = make_pose((0.0, 0.0, height)), links[support].get_sample(0)
        overlaps = [
            -compute_distance(
                one.solid,
                moved @ links[name, one.link].get_sample(0) @ one.placement,
                other.solid,
                there @ other.placement,
            )
            for one in ours
            for other in theirs
        ]
        return max(overlaps, default=-1.0)

    return compute_overlap(-DROP) > SUPPORT >= compute_overlap(DROP)


def find_supports(
    world: World,
    links: dict[tuple[str, str], Poses],
    moving: set[tuple[str, str]],
    candidates: list[str],
) -> dict[str, tuple[str, str]]:
    """Return object → (owner, link) for ungrasped free objects that rest on a moving link."""
    supports: dict[str, tuple[str, str]] = {}
    links_below = sorted(moving)
    while links_below:
        new = {}
        for name in (name for name in candidates if name not in supports):
            support = next(
                (
                    key
                    for key in links_below
                    if key[0] != name and rests_on(world, links, name, key)
                ),
                None,
            )
            if support is not None:
                new[name] = support
        supports |= new
        links_below = [(name, link) for name in new for link in world.objects[name].tree.urdf.links]
    return supports
