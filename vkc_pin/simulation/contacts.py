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
# usable bits of MuJoCo's contact types
_GROUPS = 31


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
    labels = world.collision_labels
    joints = [shape.parentJoint for shape in world.shapes]
    # Two shapes of which neither has a joint cannot move.
    movable = [(i, j) for i, j in _iterate_planner_pairs(world) if joints[i] or joints[j]]
    pairs = np.array(movable, int).reshape(-1, 2)
    named = [frozenset((labels[i], labels[j])) for i, j in pairs.tolist()]
    exempt = _find_exempt_pairs(world)
    is_excluded = np.array([(min(pair), max(pair)) in exempt for pair in pairs.tolist()], bool)
    deep = _find_overlapping_pairs(world, pairs)
    overlapping = {named[k] for k in deep.tolist() if not is_excluded[k]}
    is_excluded[deep] = True
    never = {named[k] for k in np.flatnonzero(is_excluded).tolist()}
    types = np.zeros(len(labels), int)
    affinities = np.zeros(len(labels), int)
    bits: dict[Hold, int] = {}
    groups: dict[tuple[frozenset[str], str], int] = {}  # bits of hands and links
    held_pairs = set[frozenset[str]]()
    for hold in holds:
        hands = frozenset(find_touch_links(world.scene, hold))
        link = find_grasped_link(world.scene, hold)
        own = {frozenset((hand, link)) for hand in hands}
        group = (hands, link)
        if group not in groups and not own & never and len(groups) < _GROUPS:
            bit = 1 << len(groups)
            groups[group] = bit
            types[[label in hands for label in labels]] |= bit
            affinities[[label == link for label in labels]] |= bit
        bits[hold] = groups.get(group, 0)
        held_pairs |= own
    keep = [k for k, name in enumerate(named) if not is_excluded[k] and name not in held_pairs]
    links = tuple(sorted((min(name), max(name)) for name in overlapping))
    return Pairs(pairs[keep], types, affinities, bits, links)


def _find_exempt_pairs(world: World) -> set[tuple[int, int]]:
    """Return the pairs of shapes that the scene allows to overlap, the smaller number first."""
    exempt = set[tuple[int, int]]()
    for exemption in find_clearance_exemptions(world.scene, Options().dist_safe):
        if exemption.margin < 0.0:
            exempt.update(exemption.find_shape_pairs(world.collision_labels, world.collision_keys))
    return exempt


def _find_overlapping_pairs(world: World, pairs: Ints) -> Ints:
    """Return the rows of pairs, shape (P, 2), whose shapes overlap at the start."""
    placed = CollisionShapes(world).place(world.coordinates.q(world.start[None]))
    lower_bounds = placed.compute_lower_bounds(np.zeros(len(pairs), int), pairs)
    near = np.flatnonzero(lower_bounds < 0.0)
    distances = placed.compute_distances(np.zeros(len(near), int), pairs[near])
    return near[distances < -CONTACT_DEPTH]


def _iterate_planner_pairs(world: World) -> Iterable[tuple[int, int]]:
    """Yield the pairs of shapes that the planner checks, moving or not."""
    scene = world.scene
    labels = world.collision_labels
    robot_size = len(scene.robot.collision.geometryObjects)
    body_count = len(world.bodies.geometryObjects)
    owners = [label.partition(".")[0] for label in labels]
    links = [label.partition(".")[2] for label in labels]
    for pair in scene.robot.collision.collisionPairs:
        yield pair.first, pair.second
    for i in range(body_count):
        # Wheels stand on the floor, and fixed objects may reach into it.
        if i < robot_size:
            clears_floor = world.shapes[i].parentJoint > 1
        else:
            clears_floor = scene.objects[owners[i]].object.free
        for j in range(max(i + 1, robot_size), len(labels)):
            is_floor = j >= body_count and labels[j] == FLOOR
            if is_floor and not clears_floor:
                continue
            is_same_object = robot_size <= i and j < body_count and owners[i] == owners[j]
            if is_same_object:
                own_pairs = scene.objects[owners[i]].object.own_pairs
                if frozenset((links[i], links[j])) not in own_pairs:
                    continue
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
    z = world.compute_positions(trajectory)
    placed = CollisionShapes(world).place(world.coordinates.q(z))
    labels = np.array(world.collision_labels)
    found: list[Contact] = []
    for (first, second), samples in samples_by_pair.items():
        first_shapes = np.flatnonzero(labels == first)
        second_shapes = np.flatnonzero(labels == second)
        planned = np.zeros(0)  # times at which the plan has them together [s]
        if len(first_shapes) and len(second_shapes):
            grid = np.meshgrid(first_shapes, second_shapes, indexing="ij")
            pairs = np.stack(grid, axis=-1).reshape(-1, 2)
            _, distances = placed.find_nearest(np.sort(pairs, axis=1))
            planned = trajectory.times[distances < _TOUCHING]
        contacts = np.array(samples)
        gaps = [np.min(np.abs(planned - time), initial=np.inf) for time in contacts[:, 0]]
        unplanned = contacts[np.array(gaps) > CONTACT_WINDOW]
        if not len(unplanned):
            continue
        deepest_time, depth = unplanned[np.argmax(unplanned[:, 1])].tolist()
        begin = float(unplanned[0, 0])
        duration = period * len(unplanned)
        found.append(Contact(first, second, deepest_time, begin, duration, depth))
    return tuple(sorted(found, key=lambda contact: contact.begin))
