"""How close shapes come to each other over time, and which: for plots."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from vkc_pin.arrays import Floats, Ints
from vkc_pin.motion.trajectory import Trajectory
from vkc_pin.motion.world import World
from vkc_pin.scene.scene import Scene
from vkc_pin.validation.distances import Solids
from vkc_pin.validation.pairs import PairTable
from vkc_pin.validation.touching import may_touch

__all__ = ["ClearanceCurve", "clearance_curves"]


@dataclass(frozen=True, eq=False)
class ClearanceCurve:
    """The smallest distance of any of some pairs over time.

    Attributes:
        name: What the pairs have in common.
        times: Shape (K,) [s].
        distances: Signed, negative where they overlap, shape (K,) [m].
        pairs: The closest pair at each time, by the names of its links or obstacles.
    """

    name: str
    times: Floats
    distances: Floats
    pairs: tuple[tuple[str, str], ...]

    def closest(self) -> tuple[float, float, str]:
        """Return the smallest distance [m], when it is reached [s], and the pair as text."""
        k = int(np.argmin(self.distances))
        return float(self.distances[k]), float(self.times[k]), " – ".join(self.pairs[k])


def clearance_curves(scene: Scene, trajectory: Trajectory, times: ArrayLike, *, dist_safe: float) -> list[ClearanceCurve]:
    """Return how close shapes come along a motion, for each kind of pair that there is.

    The kinds are the robot with itself, with articulated objects, with obstacles, objects with what stands around them,
    and the gripper with what it grasps, which may touch.

    Args:
        scene: Where it happens.
        trajectory: The motion.
        times: When to look, shape (K,) [s].
        dist_safe: The clearance asked for [m]; a pair that may touch is recognised by asking for less.
    """
    world = World(scene)
    solids = Solids(world)
    touching = may_touch(scene, solids, trajectory, (), dist_safe)
    table = PairTable(scene, solids, trajectory, dist_safe, touching=touching)
    moments = np.atleast_1d(np.asarray(times, float))
    kinds = np.array([_kind(table, pair, margin) for pair, margin in zip(table.pairs, table.margins, strict=True)])
    groups = {kind: table.pairs[kinds == kind] for kind in _KINDS if (kinds == kind).any()}
    placed, curves = table.solids.at(world.coordinates.q(world.positions(trajectory, moments))), []
    for kind, pairs in groups.items():
        which, distances = placed.nearest(pairs)
        names = tuple((world.collision_labels[i], world.collision_labels[j]) for i, j in pairs[which])
        curves.append(ClearanceCurve(kind, moments, distances, names))
    return curves


_KINDS = ("robot – itself", "robot – objects", "robot – obstacles", "objects – surroundings", "gripper – what it grasps")


def _kind(table: PairTable, pair: Ints, margin: float) -> str:
    first, second = (table.group[int(i)] for i in pair)
    if margin <= 0.0 and first == "robot":
        return _KINDS[4]
    if first != "robot" and second != "robot":
        return _KINDS[3]
    other = second if first == "robot" else first
    return {"robot": _KINDS[0], "": _KINDS[2]}.get(other, _KINDS[1])
