"""Computes the smallest distances of groups of pairs over time, for plots."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from vkc_pin.options import Options
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.validation.distances import CollisionShapes
from vkc_pin.validation.pairs import PairTable
from vkc_pin.world.scene.clearance_exemptions import find_clearance_exemptions
from vkc_pin.world.scene.contact_rules import find_grasped_link, find_touch_links
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

__all__ = ["ClearanceCurve", "compute_clearance_curves"]


@dataclass(frozen=True, eq=False)
class ClearanceCurve:
    """The smallest distance of a group of pairs over time.

    Attributes:
        name: Name of the group.
        times: Shape (K,) [s].
        distances: Signed distances, negative for overlaps, shape (K,) [m].
        pairs: Closest pair at each time, as names of links or obstacles.
    """

    name: str
    times: Floats
    distances: Floats
    pairs: tuple[tuple[str, str], ...]

    def closest(self) -> tuple[float, float, str]:
        """Return the smallest distance [m], its time [s] and its pair as text."""
        k = int(np.argmin(self.distances))
        return float(self.distances[k]), float(self.times[k]), " – ".join(self.pairs[k])


def compute_clearance_curves(
    scene: Scene, trajectory: Trajectory, times: ArrayLike
) -> list[ClearanceCurve]:
    """Compute the smallest distances along a motion, for each kind of pair that occurs.

    The kinds are: robot and itself, robot and objects, robot and obstacles, objects and their
    surroundings, and gripper and grasped objects, which may touch.
    """
    world = World(scene)
    solids = CollisionShapes(world)
    table = PairTable(scene, solids, trajectory, 0.0)
    silent = {
        pair
        for one in find_clearance_exemptions(scene, Options().dist_safe)
        for pair in one.find_shape_pairs(world.collision_labels, world.collision_keys)
        if one.margin == -np.inf
    }
    moments = np.atleast_1d(np.asarray(times, float))
    holds = {hold for phase in trajectory.phases for hold in phase.holds} | set(scene.holds)
    gripped = {
        (link, find_grasped_link(scene, hold))
        for hold in holds
        for link in find_touch_links(scene, hold)
    }
    kinds = np.array([_find_kind(table, pair, gripped) for pair in table.pairs])
    asked = np.array([(min(pair), max(pair)) not in silent for pair in table.pairs.tolist()], bool)
    groups = {
        kind: table.pairs[(kinds == kind) & asked]
        for kind in _KINDS
        if ((kinds == kind) & asked).any()
    }
    placed, curves = (
        table.solids.place(world.coordinates.q(world.compute_positions(trajectory, moments))),
        [],
    )
    for kind, pairs in groups.items():
        which, distances = placed.find_nearest(pairs)
        names = tuple(
            (world.collision_labels[i], world.collision_labels[j]) for i, j in pairs[which]
        )
        curves.append(ClearanceCurve(kind, moments, distances, names))
    return curves


_KINDS = (
    "robot – itself",
    "robot – objects",
    "robot – obstacles",
    "objects – surroundings",
    "gripper – grasped object",
)


def _find_kind(table: PairTable, pair: Ints, gripped: Set[tuple[str, str]]) -> str:
    first, second = (table.groups[int(i)] for i in pair)
    one, other = (table.world.collision_labels[int(i)] for i in pair)
    if first == "robot" and (one, other) in gripped:
        return _KINDS[4]
    if first != "robot" and second != "robot":
        return _KINDS[3]
    owner = second if first == "robot" else first
    return {"robot": _KINDS[0], "": _KINDS[2]}.get(owner, _KINDS[1])
