"""Every pair that could collide along a motion, and its distance at every state that matters.

A pair is left out of a stretch between two waypoints only where it cannot come close: the distance of two bodies changes
by at most what their relative motion is long.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from vkc_pin.arrays import Floats, Ints
from vkc_pin.errors import InputError
from vkc_pin.motion.trajectory import Trajectory
from vkc_pin.motion.world import World
from vkc_pin.scene.obstacles import FLOOR
from vkc_pin.scene.scene import Scene
from vkc_pin.validation.distances import Placed, Solids, travelled

__all__ = ["Hit", "PairTable"]

RESOLUTION = 1e-3  # [m] of penetration that may stay unseen between two samples
STILL = 1e-6  # [m] of relative motion between two samples that changes nothing, as of what stands where it was put


class Hit(NamedTuple):
    """A pair's distance [m] at one state: at sample `row`, or between it and the next.

    `margin` is the clearance asked for at waypoints, `contact` the overlap that counts as contact [m].
    """

    row: int
    first: str
    second: str
    distance: float
    margin: float
    contact: float
    at_waypoint: bool


class PairTable:
    """All pairs of a motion.

    Attributes:
        pairs: Indices of `world.shapes`, shape (P, 2).
        margins: Clearance each must keep at waypoints [m], shape (P,); 0 where a gripper closes on what it grasps.
        contact: Overlap that counts as contact [m], shape (P,).
        together: Whether one holds the other in some phase, so that they move as one, shape (P,): `closure` sees to that.
        solids: The shapes, to ask for distances.

    Args:
        scene: Where it happens.
        world: The scene as one plain tree.
        trajectory: The motion.
        dist_safe: Clearance to keep at the waypoints [m].
        touching: Which pairs of `world.shapes` (smaller index first) need no clearance, and the overlap of each that counts
            as contact [m].
    """

    def __init__(
        self,
        scene: Scene,
        world: World,
        trajectory: Trajectory,
        dist_safe: float,
        *,
        touching: Mapping[tuple[int, int], float] | None = None,
    ) -> None:
        touching = {} if touching is None else touching
        self.scene, self.world, self.dist_safe = scene, world, dist_safe
        self.moved = [False]  # for each joint of the world, whether the trajectory moves it or one that carries it
        for joint in range(1, world.model.njoints):
            self.moved.append(self.moved[world.model.parents[joint]] or world.model.names[joint] in trajectory.names)
        held = {owner for phase in trajectory.phases for owner in phase.held}
        self.attached = {name for name, placed in scene.objects.items() if placed.object.free and name in held}
        for name in self.attached:
            for joint in world.joints_of(name):
                self.moved[joint] = True
        robots = len(scene.robot.collision.geometryObjects)
        self._robot_pairs = {frozenset((p.first, p.second)) for p in scene.robot.collision.collisionPairs}
        labels, self.solids = world.collision_labels, Solids(world)
        bodies = range(self.solids.bodies)
        owners = [label.partition(".")[0] if "." in label else "" for label in labels]
        self.group = ["robot" if i < robots else name if name in scene.objects else "" for i, name in enumerate(owners)]
        self.pairs = np.concatenate(
            [
                np.array([(i, j) for j in bodies for i in range(j) if self._counts(i, j)], int).reshape(-1, 2),
                self._with_obstacles(),
            ]
        )
        if not len(self.pairs):
            raise InputError("no pair of geometries can collide", field="scene", expected="collision geometry")
        self.margins, self.contact = np.full(len(self.pairs), float(dist_safe)), np.zeros(len(self.pairs))
        self.together = np.zeros(len(self.pairs), bool)
        for pair, overlap in touching.items():
            which = (self.pairs == pair).all(axis=1)
            self.margins[which], self.contact[which], self.together[which] = 0.0, overlap, overlap == 0.0
        for owner, link in {(hold.object, hold.frame) for phase in trajectory.phases for hold in phase.holds if hold.by}:
            ones, others = np.array(self.group) == owner, np.array(labels) == link
            first, second = self.pairs.T
            self.together |= (ones[first] & others[second]) | (others[first] & ones[second])
        self._sort()

    def _counts(self, i: int, j: int) -> bool:
        """Return whether two bodies i < j (robot first, then objects) can collide at all."""
        shapes, a, b = self.world.shapes, self.group[i], self.group[j]
        if a == "robot" and b == "robot":
            return frozenset((i, j)) in self._robot_pairs
        if a == "robot":
            return True
        if a == b:  # an object with itself
            return False
        return self.moved[shapes[i].parentJoint] or self.moved[shapes[j].parentJoint]

    def _with_obstacles(self) -> Ints:
        """Return the pairs of what moves with the obstacles, shape (n, 2), by obstacle."""
        bodies, labels = range(self.solids.bodies), self.world.collision_labels
        joints = [self.world.shapes[i].parentJoint for i in bodies]
        moving = [i for i in bodies if self.group[i] == "robot" or self.moved[joints[i]]]
        # Wheels stand on the floor, objects hang as their makers hung them.
        above = [i for i in moving if self.group[i] in self.attached or (self.group[i] == "robot" and joints[i] > 1)]
        obstacles = range(self.solids.bodies, len(labels))
        found = [np.zeros((0, 2), int)]
        for floor, ones in ((False, moving), (True, above)):
            others = [j for j in obstacles if (labels[j] == FLOOR) == floor]
            found.append(np.column_stack([np.tile(np.array(ones, int), len(others)), np.repeat(others, len(ones))]))
        return np.concatenate(found).astype(int)

    def _sort(self) -> None:
        """Part the pairs of which both move from those of which one stands still all along the motion."""
        moves = np.array([self.group[i] == "robot" or self.moved[shape.parentJoint] for i, shape in enumerate(self.world.shapes)])
        both = moves[self.pairs].all(axis=1)
        self._both, mixed = np.flatnonzero(both), np.flatnonzero(~both)
        pairs = self.pairs[mixed]
        pairs = np.where(moves[pairs[:, :1]], pairs, pairs[:, ::-1])  # what moves comes first
        self._moving, self._still = (np.unique(column) for column in pairs.T)
        self._number = np.full((len(self._moving), len(self._still)), -1)
        self._number[np.searchsorted(self._moving, pairs[:, 0]), np.searchsorted(self._still, pairs[:, 1])] = mixed

    def sweep(self, z: Floats, waypoints: Ints) -> Iterator[Hit]:
        """Yield what is close along the motion, and at least the closest pair of every waypoint.

        Args:
            z: Sampled configurations of the world, shape (S, n), evenly spaced between waypoints.
            waypoints: Rows of `z` that are waypoints, shape (T,).
        """
        configuration, smallest = self.world.coordinates.q, np.inf
        placed = [self.solids.at(q) for q in configuration(z[waypoints])]
        for row, here in zip(waypoints.tolist(), placed, strict=True):
            near, at = self._nearest(here)
            smallest = min(smallest, float(at.min()))
            for c in {int(np.argmin(at)), *np.flatnonzero(at < self.margins[near]).tolist()}:
                yield self._hit(row, near[c], at[c], at_waypoint=True)
        smallest = max(RESOLUTION, smallest)  # what cannot come closer than that changes nothing
        moved = travelled(self.solids, z)
        for (first, here), (last, there) in itertools.pairwise(zip(waypoints.tolist(), placed, strict=True)):
            pairs = self._active(here, there, moved[last] - moved[first], smallest)
            ends = here.distances(self.pairs[pairs]), there.distances(self.pairs[pairs])
            yield from self._between(z, (first, last), pairs, ends, moved=moved, smallest=smallest)

    def _between(
        self, z: Floats, rows: tuple[int, int], pairs: Ints, ends: tuple[Floats, Floats], *, moved: Floats, smallest: float
    ) -> Iterator[Hit]:
        """Yield what comes closer than `smallest` at samples between two others, halves of which are left out where nothing can.

        d(s) ≥ (d_t + d_{t+1} − relative motion) / 2 for every state in between. Without motion it is what it is at both ends;
        an overlap is looked at all the same, to be told of wherever it is.

        Args:
            z: Sampled configurations of the world, shape (S, n).
            rows: The two samples.
            pairs: What may come so close, shape (n,).
            ends: Their distances at both [m].
            moved: See `travelled`.
            smallest: [m].
        """
        todo = [(rows, pairs, ends)]
        while todo:
            (low, high), pairs, (before, after) = todo.pop()
            motion = (moved[high] - moved[low])[self.pairs[pairs]].sum(axis=1)
            some = (before + after - motion < 2 * smallest) & ((motion > STILL) | (before < 0))
            pairs, before, after, motion = pairs[some], before[some], after[some], motion[some]
            if not len(pairs):
                continue
            if high - low == 1:
                yield from self._slipping(z, low, pairs, (before, after), motion)
                continue
            middle = (low + high) // 2
            distances = self.solids.at(self.world.coordinates.q(z[middle])).distances(self.pairs[pairs])
            for c in {int(np.argmin(distances)), *np.flatnonzero(distances < 0).tolist()}:
                yield self._hit(middle, pairs[c], distances[c])
            todo += [((low, middle), pairs, (before, distances)), ((middle, high), pairs, (distances, after))]

    def _slipping(self, z: Floats, row: int, pairs: Ints, ends: tuple[Floats, Floats], motion: Floats) -> Iterator[Hit]:
        """Yield what overlaps between a sample and the next, at both of which it is free: nothing deeper than 1 mm can hide.

        Args:
            z: Sampled configurations of the world, shape (S, n).
            row: The first of the two samples.
            pairs: The pairs, shape (n,).
            ends: Their distances at both [m].
            motion: How far any two points of a pair can move relative to each other in between [m].
        """
        overlap = self.contact[pairs]
        free = (np.minimum(*ends) >= -overlap) & (ends[0] + ends[1] < motion) & ~self.together[pairs]
        for c in np.flatnonzero(free).tolist():
            stack = [(0.0, 1.0, ends[0][c], ends[1][c])]
            while stack:
                low, high, before, after = stack.pop()
                if (width := (high - low) * motion[c]) <= 2 * RESOLUTION or before + after >= width:
                    continue
                middle = (low + high) / 2
                state = self.solids.at(self.world.coordinates.q((1 - middle) * z[row] + middle * z[row + 1]))
                between = state.distance(*self.pairs[pairs[c]].tolist())
                yield self._hit(row, pairs[c], between)
                if between < -overlap[c]:
                    break
                stack += [(low, middle, before, between), (middle, high, between, after)]

    def _close(self, placed: Placed, reach: Floats) -> Ints:
        """Return all pairs but those of which one stands still and the other is at least `reach` from it; shape (G,) [m]."""
        lower, upper = placed.corners
        low, high = lower[self._moving] - reach[self._moving, None], upper[self._moving] + reach[self._moving, None]
        near = np.ones(self._number.shape, bool)
        for axis in range(3):
            near &= low[:, axis, None] < upper[self._still, axis]
            near &= high[:, axis, None] > lower[self._still, axis]
        found = self._number[near]
        return np.sort(np.concatenate([self._both, found[found >= 0]]))

    def _nearest(self, placed: Placed) -> tuple[Ints, Floats]:
        """Return pairs, the closest and all that fall short of their margins among them, and their distances [m]."""
        reach = max(float(self.margins.max()), RESOLUTION)
        while True:
            near = self._close(placed, np.full(len(self.group), reach))
            near = near[placed.bounds(self.pairs[near]) < reach]
            distances = placed.distances(self.pairs[near])
            if not distances.min(initial=np.inf) > reach:  # all others are further apart
                return near, distances
            reach *= 2.0

    def _active(self, here: Placed, there: Placed, moved: Floats, smallest: float) -> Ints:
        """Return all pairs but those that boxes prove to stay `smallest` apart between two waypoints [m].

        Where d(s) of `_between` is less, one of both distances is less than `smallest` and half the relative motion.

        Args:
            here: The world at the one.
            there: The world at the other.
            moved: How far any point of each geometry moves in between, shape (G,) [m].
            smallest: [m].
        """
        reach = smallest + moved / 2
        some = np.union1d(self._close(here, reach), self._close(there, reach))
        pairs = self.pairs[some]
        floor = (here.bounds(pairs) + there.bounds(pairs) - moved[pairs].sum(axis=1)) / 2
        return some[floor < smallest]

    def _hit(self, row: int, k: int, distance: float, *, at_waypoint: bool = False) -> Hit:
        first, second = (self.world.collision_labels[i] for i in self.pairs[k])
        limits = {"margin": float(self.margins[k]), "contact": float(self.contact[k])}
        return Hit(int(row), first, second, float(distance), **limits, at_waypoint=at_waypoint)
