"""Finds objects that rest on moving links, and move with them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import coal

from .poses import Poses, make_pose

if TYPE_CHECKING:
    from .stage import World

__all__ = ["compute_distance", "find_riders", "rests_on"]

DROP = 5e-3  # [m] by which an object is lowered to find its support
SUPPORT = 2.5e-3  # [m] least overlap with the support then

_REQUEST, _RESULT = coal.DistanceRequest(), coal.DistanceResult()


def compute_distance(one: object, here: Poses, other: object, there: Poses, k: int = 0) -> float:
    """Return the signed distance of two shapes at moment k [m]."""
    i, j = (0 if len(place.turn) == 1 else k for place in (here, there))
    a, b = coal.Transform3s(here.turn[i], here.at[i]), coal.Transform3s(there.turn[j], there.at[j])
    _RESULT.clear()
    return float(coal.distance(one, a, other, b, _REQUEST, _RESULT))


def rests_on(
    world: World, links: dict[tuple[str, str], Poses], name: str, support: tuple[str, str]
) -> bool:
    """Return whether an object overlaps a link by over 2.5 mm at 5 mm lower, not 5 mm higher."""
    ours = world.objects[name].tree.urdf.shapes
    theirs = [
        shape for shape in world.objects[support[0]].tree.urdf.shapes if shape.link == support[1]
    ]

    def overlap(height: float) -> float:
        moved, there = make_pose((0.0, 0.0, height)), links[support].row(0)
        found = [
            -compute_distance(
                one.solid,
                moved @ links[name, one.link].row(0) @ one.place,
                other.solid,
                there @ other.place,
            )
            for one in ours
            for other in theirs
        ]
        return max(found, default=-1.0)

    return overlap(-DROP) > SUPPORT >= overlap(DROP)


def find_riders(
    world: World,
    links: dict[tuple[str, str], Poses],
    moving: set[tuple[str, str]],
    waiting: list[str],
) -> dict[str, tuple[str, str]]:
    """Return object → (owner, link) of ungrasped free objects that rest on a moving link."""
    found: dict[str, tuple[str, str]] = {}
    below = sorted(moving)
    while below:
        new = {}
        for name in (name for name in waiting if name not in found):
            support = next(
                (key for key in below if key[0] != name and rests_on(world, links, name, key)),
                None,
            )
            if support is not None:
                new[name] = support
        found |= new
        below = [(name, link) for name in new for link in world.objects[name].tree.urdf.links]
    return found
