"""Collision pairs of a robot's links: finds those that need no check by sampling, and writes them as an SRDF."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Collection, Iterable
from pathlib import Path
from xml.sax.saxutils import quoteattr

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.arrays import Floats
from vkc_pin.files.writing import write_atomically
from vkc_pin.models.robot import Robot

Pair = tuple[str, str]

__all__ = ["sample_allowed_pairs", "with_collision_pairs", "write_srdf"]

_SAMPLES = 20_000
_FAR = 0.05  # [m]: links that come no closer in any sample are not driven together
_STARTS, _STEPS = 4, 200  # how often and in how many steps the others are


def with_collision_pairs(robot: Robot, allowed: Collection[Pair]) -> Robot:
    """Return `robot` with those of its links that move against each other as collision pairs, less the `allowed` ones.

    Args:
        robot: The robot; its own collision pairs play no part.
        allowed: Pairs of links that may touch, each sorted.
    """
    collision, shapes = pin.GeometryModel(), robot.collision.geometryObjects
    for shape in shapes:
        collision.addGeometryObject(shape)
    for first, second in itertools.combinations(range(len(shapes)), 2):
        links = tuple(sorted((robot.link_of(first), robot.link_of(second))))
        if shapes[first].parentJoint != shapes[second].parentJoint and links not in allowed:
            collision.addCollisionPair(pin.CollisionPair(first, second))
    return dataclasses.replace(robot, collision=collision)


def sample_allowed_pairs(robot: Robot, *, samples: int = _SAMPLES, seed: int = 0) -> dict[tuple[str, str], str]:
    """Return the pairs of links that need not be kept apart, each sorted, with the reason.

    "Adjacent": a joint connects them. "Always": they collide in every sample. "Never": they collide in no sample, and
    those that came closer than 50 mm not even when they are driven together from their closest samples. Samples are
    uniform within the joints' limits (±π where there are none), the base standing still.

    Args:
        robot: The robot; its own collision pairs play no part.
        samples: How many configurations to look at.
        seed: Of the random numbers; the same seed gives the same pairs.
    """
    shapes = robot.collision.geometryObjects
    adjacent, allowed = _adjacent(robot), {}
    groups: dict[Pair, list[tuple[int, int]]] = {}
    for first, second in itertools.combinations(range(len(shapes)), 2):
        if shapes[first].parentJoint == shapes[second].parentJoint:
            continue
        one, other = sorted((robot.link_of(first), robot.link_of(second)))
        if (one, other) in adjacent:
            allowed[one, other] = "Adjacent"
        else:
            groups.setdefault((one, other), []).append((first, second))
    rng, distances = np.random.default_rng(seed), _Distances(robot)
    low, high = np.where(np.isfinite(robot.lower), robot.lower, -np.pi), np.where(np.isfinite(robot.upper), robot.upper, np.pi)
    low[:3] = high[:3] = 0.0
    free: set[Pair] = set()
    hit: set[Pair] = set()
    closest: dict[Pair, list[tuple[float, tuple[float, ...]]]] = {links: [] for links in groups}
    undecided = list(groups)
    for z in rng.uniform(low, high, (samples, len(low))):
        distances.place(z)
        for links in undecided:
            best = closest[links]
            distance = distances.between(groups[links], min(_FAR, best[-1][0]) if len(best) == _STARTS else _FAR)
            (free if distance > 0.0 else hit).add(links)
            if distance < _FAR and links not in hit and (len(best) < _STARTS or distance < best[-1][0]):
                closest[links] = sorted([*best, (distance, tuple(z))])[:_STARTS]
        undecided = [links for links in undecided if links not in free or links not in hit]
    for links, parts in groups.items():
        if links not in free:
            allowed[links] = "Always"
        elif links not in hit:
            starts = (np.array(z) for _, z in closest[links])
            if not any(_drive_together(distances, parts, z, (low, high), rng) for z in starts):
                allowed[links] = "Never"
    return dict(sorted(allowed.items()))


def write_srdf(robot: Robot, path: str | Path, *, samples: int = _SAMPLES, seed: int = 0) -> Path:
    """Write an SRDF with the allowed collisions of `robot` and its home; at once, so that no reader sees half a file.

    Args:
        robot: The robot.
        path: The file to write.
        samples: See `sample_allowed_pairs`.
        seed: The same.

    Returns:
        The file.
    """
    lines = [
        '<?xml version="1.0"?>',
        f"<!-- Written by `vkc-pin srdf`: {samples} samples, seed {seed}. Adjacent: a joint connects the links. Always: they",
        "     collide in every sample. Never: in none, nor when driven together from those in which they came closest. -->",
        f"<robot name={quoteattr(robot.name)}>",
        '  <group name="arm">',
        *(f"    <joint name={quoteattr(name)}/>" for name in robot.coordinates.names[3:]),
        "  </group>",
        '  <group_state name="home" group="arm">',
        *(
            f"    <joint name={quoteattr(name)} value={quoteattr(f'{value:.12g}')}/>"
            for name, value in zip(robot.coordinates.names[3:], robot.home, strict=True)
        ),
        "  </group_state>",
        *(
            f"  <disable_collisions link1={quoteattr(one)} link2={quoteattr(other)} reason={quoteattr(reason)}/>"
            for (one, other), reason in sample_allowed_pairs(robot, samples=samples, seed=seed).items()
        ),
        "</robot>",
    ]
    return write_atomically(path, ("\n".join(lines) + "\n").encode())


class _Distances:
    def __init__(self, robot: Robot) -> None:
        shapes = robot.collision.geometryObjects
        self._robot, self._data = robot, robot.model.createData()
        self._solids = [shape.geometry for shape in shapes]
        self._joints = np.array([shape.parentJoint for shape in shapes])
        self._locals = [shape.placement for shape in shapes]
        for solid in self._solids:
            solid.computeLocalAABB()
        self._radii = np.array([solid.aabb_radius for solid in self._solids])
        self._middles = np.array([place.act(solid.aabb_center) for place, solid in zip(self._locals, self._solids, strict=True)])
        self._request, self._result = coal.DistanceRequest(), coal.DistanceResult()

    def place(self, z: Floats) -> None:
        """Put the robot at coordinates `z`, shape (n,)."""
        pin.forwardKinematics(self._robot.model, self._data, self._robot.coordinates.q(z))
        rotations = np.array([place.rotation for place in self._data.oMi])[self._joints]
        positions = np.array([place.translation for place in self._data.oMi])[self._joints]
        self._centres = np.einsum("kij,kj->ki", rotations, self._middles) + positions
        self._places: dict[int, coal.Transform3s] = {}

    def between(self, parts: Iterable[tuple[int, int]], worth: float = np.inf) -> float:
        """Return the smallest distance [m] of pairs of shapes; a lower bound of it where it is larger than `worth`."""
        smallest = np.inf
        for first, second in parts:
            gap = self._centres[first] - self._centres[second]
            bound = float(np.sqrt(gap @ gap) - self._radii[first] - self._radii[second])
            if bound <= min(smallest, worth):
                self._result.clear()
                one, other = ((self._solids[shape], self._place(shape)) for shape in (first, second))
                bound = coal.distance(*one, *other, self._request, self._result)
            smallest = min(smallest, float(bound))
        return smallest

    def _place(self, shape: int) -> coal.Transform3s:
        if shape not in self._places:
            place = self._data.oMi[int(self._joints[shape])] * self._locals[shape]
            self._places[shape] = coal.Transform3s(place.rotation, place.translation)
        return self._places[shape]


def _drive_together(
    distances: _Distances, parts: list[tuple[int, int]], z: Floats, limits: tuple[Floats, Floats], rng: np.random.Generator
) -> bool:
    """Return whether random steps from `z` that lessen the distance end in a collision."""
    low, high = limits
    distances.place(z)
    nearest = distances.between(parts)
    for width in np.geomspace(0.2, 0.002, _STEPS):
        trial = np.clip(z + width * (high - low) / 6.0 * rng.standard_normal(len(z)), low, high)
        distances.place(trial)
        distance = distances.between(parts)
        if distance < nearest:
            z, nearest = trial, distance
        if nearest <= 0.0:
            return True
    return False


def _adjacent(robot: Robot) -> set[tuple[str, str]]:
    """Return the pairs of links with collision shapes that one joint connects, or only links without shapes."""
    parents = {}
    for joint in robot.file.root.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is not None and child is not None:
            parents[child.get("link", "")] = parent.get("link", "")
    solid = set(robot.links)
    pairs = set()
    for link in solid:
        above = parents.get(link)
        while above is not None and above not in solid:
            above = parents.get(above)
        if above is not None:
            first, second = sorted((link, above))
            pairs.add((first, second))
    return pairs
