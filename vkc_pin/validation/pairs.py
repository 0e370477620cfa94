"""Every pair that could collide along a motion, what is asked of each, and which may be close."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from vkc_pin.arrays import Floats, Ints
from vkc_pin.errors import InputError
from vkc_pin.motion.trajectory import Trajectory
from vkc_pin.scene.obstacles import FLOOR
from vkc_pin.scene.scene import Scene
from vkc_pin.validation.distances import Placed, Solids

__all__ = ["PairTable"]

_AT_ONCE = 16  # states whose boxes are compared at once


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
        solids: The shapes of the scene as one plain tree.
        trajectory: The motion.
        dist_safe: Clearance to keep at the waypoints [m].
        touching: Which pairs of `world.shapes` (smaller index first) need no clearance, and the overlap of each that counts
            as contact [m].
    """

    def __init__(
        self,
        scene: Scene,
        solids: Solids,
        trajectory: Trajectory,
        dist_safe: float,
        *,
        touching: Mapping[tuple[int, int], float] | None = None,
    ) -> None:
        touching = {} if touching is None else touching
        self.scene, self.world, self.solids, self.dist_safe = scene, solids.world, solids, dist_safe
        world = self.world
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
        labels, bodies = world.collision_labels, range(solids.bodies)
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

    def close(self, placed: Placed, states: Ints, reach: Floats, also: Ints | None = None) -> tuple[Ints, Ints]:
        """Return (k, pair) of all pairs but those of which one stands still and the other is at least `reach` from it.

        Args:
            placed: The world at some states.
            states: Which of these, shape (K,).
            reach: Of each geometry, shape (K, G) [m].
            also: Others, shape (K,): what is close there counts as well.
        """
        lower, upper = placed.corners
        lows, highs = (np.ascontiguousarray(corners[0, self._still].T) for corners in (lower, upper))
        far, moments = reach[:, self._moving, None], (states,) if also is None else (states, also)
        boxes = [(lower[at][:, self._moving] - far, upper[at][:, self._moving] + far) for at in moments]
        found = [(np.repeat(np.arange(len(states)), len(self._both)), np.tile(self._both, len(states)))]
        for k in range(0, len(states), _AT_ONCE) if self._number.size else ():
            part = slice(k, k + _AT_ONCE)
            least = np.min([low[part].min(axis=(0, 1)) for low, _ in boxes], axis=0)[:, None]
            most = np.max([high[part].max(axis=(0, 1)) for _, high in boxes], axis=0)[:, None]
            (some,) = ((least < highs) & (most > lows)).all(axis=0).nonzero()  # of what stands, all that any may come close to
            number = self._number[:, some]
            near = np.zeros((len(states[part]), *number.shape), bool)
            for low, high in boxes:
                inside = np.tile(number >= 0, (len(near), 1, 1))
                for axis in range(3):
                    inside &= low[part, :, None, axis] < highs[axis, some]
                    inside &= high[part, :, None, axis] > lows[axis, some]
                near |= inside
            at, *which = np.nonzero(near)
            found.append((at + k, number[tuple(which)]))
        at, pairs = (np.concatenate(parts) for parts in zip(*found, strict=True))
        order = np.lexsort((pairs, at))
        return at[order], pairs[order]
