"""Selects the contact pairs of a simulation, and finds contacts that were not planned.

The pairs are those between which the planner keeps a clearance: the robot's own pairs that can
collide, robot and objects with each other and with the world, and the floor below free objects and
the arm. Excluded are pairs that overlap from the start or need no clearance, and a hand with the
link to which it is welded, for the time of the weld.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from vkc_pin.options import Options
from vkc_pin.utils.arrays import Ints
from vkc_pin.validation.distances import CollisionShapes
from vkc_pin.world.scene.clearance_exemptions import CONTACT_DEPTH, find_clearance_exemptions
from vkc_pin.world.scene.contact_rules import (
    CONTACT_WINDOW,
    find_grasped_link,
    find_touch_links,
)
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

# [m] Links that are planned to be closer may touch: some descriptions put cups a millimetre above
# tables.
_TOUCHING = 2e-3
_GROUPS = 31  # usable bits of MuJoCo's contact types


@dataclass(frozen=True)
class Contact:
    """Two links that touched although the plan keeps them apart.

    Attributes:
        first, second: Links "<link>" or "<object>.<link>", or names of obstacles.
        time: Time of the deepest penetration [s], on the plan's clock.
        begin: Time of the first contact [s].
        duration: Total duration of contact [s].
        depth: Largest penetration depth [m].
    """

    first: str
    second: str
    time: float
    begin: float
    duration: float
    depth: float

    def __str__(self) -> str:
        depth = f"{1e3 * self.depth:.1f} mm deep at {self.time:.2f} s"
        span = f"from {self.begin:.2f} s on for {self.duration:.2f} s"
        return f"{self.first} – {self.second}: {depth} ({span})"

    def to_dict(self) -> dict[str, Any]:
        """Return the contact as plain data."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class Pairs:
    """Shapes of a world that may touch.

    Attributes:
        always: Pairs of shape numbers that collide at any time, shape (P, 2).
        types, affinities: Bits of `contype` and `conaffinity` of each shape, shape (G,), through
            which holders and held links collide.
        bits: Maps each hold to the bit through which holder and held link collide unless the hold
            is active; 0 if they never collide.
        overlapping: Links whose shapes overlap at the start and therefore never collide.
    """

    always: Ints
    types: Ints
    affinities: Ints
    bits: dict[Hold, int]
    overlapping: tuple[tuple[str, str], ...]


def find_contact_pairs(world: World, holds: Iterable[Hold]) -> Pairs:
    """Return the pairs of shapes that may touch."""
    labels, joints = world.collision_labels, [shape.parentJoint for shape in world.shapes]
    pairs = np.array(
        [pair for pair in _iterate_planner_pairs(world) if joints[pair[0]] or joints[pair[1]]], int
    ).reshape(-1, 2)
    exempt = {
        pair
        for one in find_clearance_exemptions(world.scene, Options().dist_safe)
        for pair in one.find_shape_pairs(labels, world.collision_keys)
        if one.margin < 0.0
    }
    excluded = np.array([(min(pair), max(pair)) in exempt for pair in pairs.tolist()], bool)
    named = [frozenset((labels[i], labels[j])) for i, j in pairs.tolist()]
    placed = CollisionShapes(world).place(world.coordinates.q(world.start[None]))
    near = np.flatnonzero(placed.compute_lower_bounds(np.zeros(len(pairs), int), pairs) < 0.0)
    deep = near[placed.compute_distances(np.zeros(len(near), int), pairs[near]) < -CONTACT_DEPTH]
    overlapping = {named[k] for k in deep.tolist() if not excluded[k]}
    excluded[deep] = True
    never = {named[k] for k in np.flatnonzero(excluded).tolist()}
    types, affinities = np.zeros((2, len(labels)), int)
    bits = dict[Hold, int]()
    groups = dict[tuple[frozenset[str], str], int]()
    held_pairs = set[frozenset[str]]()
    for hold in holds:
        hands = frozenset(find_touch_links(world.scene, hold))
        link = find_grasped_link(world.scene, hold)
        own = {frozenset((hand, link)) for hand in hands}
        bits[hold] = groups.get((hands, link), 0)
        if (hands, link) not in groups and not own & never and len(groups) < _GROUPS:
            bits[hold] = groups[hands, link] = 1 << len(groups)
            types[[label in hands for label in labels]] |= bits[hold]
            affinities[[label == link for label in labels]] |= bits[hold]
        held_pairs |= own
    keep = [k for k, name in enumerate(named) if not excluded[k] and name not in held_pairs]
    links = tuple(sorted((min(name), max(name)) for name in overlapping))
    return Pairs(pairs[keep], types, affinities, bits, links)


def _iterate_planner_pairs(world: World) -> Iterable[tuple[int, int]]:
    """Yield the pairs of shapes that the planner checks, moving or not."""
    scene, labels = world.scene, world.collision_labels
    robots, bodies = len(scene.robot.collision.geometryObjects), len(world.bodies.geometryObjects)
    owners = [label.partition(".")[0] for label in labels]
    free = {name for name, placed in scene.objects.items() if placed.object.free}
    yield from ((pair.first, pair.second) for pair in scene.robot.collision.collisionPairs)
    for i in range(bodies):
        for j in range(max(i + 1, robots), len(labels)):
            # Wheels stand on the floor, and fixed objects may reach into it.
            is_floor = j >= bodies and labels[j] == FLOOR
            if is_floor and not (
                world.shapes[i].parentJoint > 1 if i < robots else owners[i] in free
            ):
                continue
            same = robots <= i and j < bodies and owners[i] == owners[j]
            links = frozenset(labels[k].partition(".")[2] for k in (i, j))
            if not same or links in scene.objects[owners[i]].object.own_pairs:
                yield i, j


def find_unplanned_contacts(
    scene: Scene,
    trajectory: Trajectory,
    samples_by_pair: dict[tuple[str, str], list[tuple[float, float]]],
    period: float,
) -> tuple[Contact, ...]:
    """Return the contacts that the plan does not have.

    A contact is unplanned if the links stay apart in the plan for `CONTACT_WINDOW` before and
    after it.

    Args:
        scene: Scene of the plan.
        trajectory: The plan.
        samples_by_pair: Maps pairs of labels to samples (time [s], depth [m]) at which they
            touched.
        period: Sampling period [s].
    """
    if not samples_by_pair:
        return ()
    world = World(scene)
    placed = CollisionShapes(world).place(world.coordinates.q(world.compute_positions(trajectory)))
    found = []
    for (first, second), samples in samples_by_pair.items():
        ones, others = (
            [k for k, label in enumerate(world.collision_labels) if label == one]
            for one in (first, second)
        )
        together = np.zeros(0)
        if ones and others:
            pairs = np.array([(i, j) for i in ones for j in others])
            _, distances = placed.find_nearest(np.sort(pairs, axis=1))
            together = trajectory.times[distances < _TOUCHING]
        moments = np.array(samples)
        far = np.array(
            [np.min(np.abs(together - t), initial=np.inf) > CONTACT_WINDOW for t in moments[:, 0]]
        )
        moments = moments[far]
        if len(moments):
            time, depth = moments[np.argmax(moments[:, 1])].tolist()
            found.append(
                Contact(first, second, time, float(moments[0, 0]), period * len(moments), depth)
            )
    return tuple(sorted(found, key=lambda contact: contact.begin))
