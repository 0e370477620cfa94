"""What may touch what, by the planner's own rules, and which contacts of an executed motion the plan did not have.

The pairs are those that the planner keeps apart: the robot's own pairs that can collide, robot and
objects with each other and with the world, and the floor below what is carried or on the arm. Pairs
that overlap from the start, or need no clearance, do not push each other apart. Neither do a hand
and the link that it is welded to, while it is.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from vkc_pin.options import Options
from vkc_pin.utils.arrays import Ints
from vkc_pin.validation.distances import Solids
from vkc_pin.world.scene.clearance_exemptions import allowances
from vkc_pin.world.scene.contact_rules import CONTACT, EASED_TIME, grasped, touching
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

__all__ = ["Contact", "Pairs", "touching_pairs", "unwanted"]

# [m] what is planned to be closer than this may as well touch: descriptions put cups a millimetre
# above tables
_TOUCHING = 2e-3
_GROUPS = 31  # bits of MuJoCo's contact types


@dataclass(frozen=True)
class Contact:
    """Two links that touched where the plan has them apart.

    Attributes:
        first, second: Links "<link>" or "<object>.<link>", or an obstacle's name.
        time: When they were deepest in each other [s], in the plan's time.
        begin: When they touched first [s].
        duration: For how long in all [s].
        depth: How deep at most [m].
    """

    first: str
    second: str
    time: float
    begin: float
    duration: float
    depth: float

    def __str__(self) -> str:
        lasts = f"from {self.begin:.2f} s on for {self.duration:.2f} s"
        return f"{self.first} – {self.second}: {1e3 * self.depth:.1f} mm deep at {self.time:.2f} s ({lasts})"

    def to_dict(self) -> dict[str, Any]:
        """Return plain data of it."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class Pairs:
    """Which shapes of a world meet.

    Attributes:
        always: Pairs that do at any time, by the numbers of their shapes, shape (P, 2).
        types, affinities: Of every shape, shape (G,): bits of `contype` and `conaffinity`, by which
            the pairs of holds meet.
        bits: Hold → the bit by which what holds meets the link that it holds, unless it does; 0 if
            they never meet.
        overlapping: Links with shapes that overlap at the start and so never meet.
    """

    always: Ints
    types: Ints
    affinities: Ints
    bits: dict[Hold, int]
    overlapping: tuple[tuple[str, str], ...]


def touching_pairs(world: World, holds: Iterable[Hold]) -> Pairs:
    """Return which shapes of a world meet.

    Args:
        world: The world, as it is at the start.
        holds: All that is ever held firmly enough to be welded.
    """
    labels, joints = world.collision_labels, [shape.parentJoint for shape in world.shapes]
    pairs = np.array(
        [pair for pair in _candidates(world) if joints[pair[0]] or joints[pair[1]]], int
    ).reshape(-1, 2)
    silent = {
        pair
        for one in allowances(world.scene, Options().dist_safe)
        for pair in one.shape_pairs(labels, world.collision_keys)
        if one.margin < 0.0
    }
    quiet = np.array([(min(pair), max(pair)) in silent for pair in pairs.tolist()], bool)
    named = [frozenset((labels[i], labels[j])) for i, j in pairs.tolist()]
    placed = Solids(world).at(world.coordinates.q(world.start[None]))
    near = np.flatnonzero(placed.bounds(np.zeros(len(pairs), int), pairs) < 0.0)
    deep = near[placed.distances(np.zeros(len(near), int), pairs[near]) < -CONTACT]
    apart = {named[k] for k in deep.tolist() if not quiet[k]}
    quiet[deep] = True
    never = {named[k] for k in np.flatnonzero(quiet).tolist()}
    types, affinities = np.zeros((2, len(labels)), int)
    bits, groups, gripped = (
        dict[Hold, int](),
        dict[tuple[frozenset[str], str], int](),
        set[frozenset[str]](),
    )
    for hold in holds:
        hands, link = frozenset(touching(world.scene, hold)), grasped(world.scene, hold)
        own = {frozenset((hand, link)) for hand in hands}
        bits[hold] = groups.get((hands, link), 0)
        if (hands, link) not in groups and not own & never and len(groups) < _GROUPS:
            bits[hold] = groups[hands, link] = 1 << len(groups)
            types[[label in hands for label in labels]] |= bits[hold]
            affinities[[label == link for label in labels]] |= bits[hold]
        gripped |= own
    keep = [k for k, name in enumerate(named) if not quiet[k] and name not in gripped]
    links = tuple(sorted((min(name), max(name)) for name in apart))
    return Pairs(pairs[keep], types, affinities, bits, links)


def _candidates(world: World) -> Iterable[tuple[int, int]]:
    """Yield the pairs of shapes that the planner looks at, whatever moves."""
    scene, labels = world.scene, world.collision_labels
    robots, bodies = len(scene.robot.collision.geometryObjects), len(world.bodies.geometryObjects)
    owners = [label.partition(".")[0] for label in labels]
    free = {name for name, placed in scene.objects.items() if placed.object.free}
    yield from ((pair.first, pair.second) for pair in scene.robot.collision.collisionPairs)
    for i in range(bodies):
        for j in range(max(i + 1, robots), len(labels)):
            stands = (
                j >= bodies and labels[j] == FLOOR
            )  # as wheels do; objects that do not move freely hang in their walls
            if stands and not (
                world.shapes[i].parentJoint > 1 if i < robots else owners[i] in free
            ):
                continue
            same = robots <= i and j < bodies and owners[i] == owners[j]
            links = frozenset(labels[k].partition(".")[2] for k in (i, j))
            if not same or links in scene.objects[owners[i]].object.own_pairs:
                yield i, j


def unwanted(
    scene: Scene,
    trajectory: Trajectory,
    seen: dict[tuple[str, str], list[tuple[float, float]]],
    period: float,
) -> tuple[Contact, ...]:
    """Return contacts that the plan does not have: the links are further apart in it for `EASED_TIME` before and after.

    Args:
        scene: The scene that was planned in.
        trajectory: The plan.
        seen: Pair of labels → (time [s], depth [m]) at every time at which they touched.
        period: Between two such times [s].
    """
    if not seen:
        return ()
    world = World(scene)
    placed = Solids(world).at(world.coordinates.q(world.positions(trajectory)))
    found = []
    for (first, second), samples in seen.items():
        ones, others = (
            [k for k, label in enumerate(world.collision_labels) if label == one]
            for one in (first, second)
        )
        together = np.zeros(0)
        if ones and others:
            pairs = np.array([(i, j) for i in ones for j in others])
            _, distances = placed.nearest(np.sort(pairs, axis=1))
            together = trajectory.times[distances < _TOUCHING]
        moments = np.array(samples)
        far = np.array(
            [np.min(np.abs(together - t), initial=np.inf) > EASED_TIME for t in moments[:, 0]]
        )
        moments = moments[far]
        if len(moments):
            time, depth = moments[np.argmax(moments[:, 1])].tolist()
            found.append(
                Contact(first, second, time, float(moments[0, 0]), period * len(moments), depth)
            )
    return tuple(sorted(found, key=lambda contact: contact.begin))
