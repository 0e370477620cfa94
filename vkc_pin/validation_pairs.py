"""Every pair that could collide along a motion, and its distance at every state that matters.

A pair is left out of a stretch between two waypoints only where it cannot come close: the distance of two bodies changes
by at most what their relative motion is long.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin.errors import InputError
from vkc_pin.geometry import bounding_box
from vkc_pin.scene import FLOOR, Scene
from vkc_pin.trajectory import Trajectory
from vkc_pin.world import World

__all__ = ["Hit", "PairTable"]

RESOLUTION = 1e-3  # [m] of penetration that may stay unseen between two samples


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
        pairs: Geometry indices in `world.collision`, shape (P, 2).
        margins: Clearance each must keep at waypoints [m], shape (P,); 0 where a gripper closes on what it grasps.
        contact: Overlap that counts as contact [m], shape (P,).
        together: Whether one holds the other in some phase, so that they move as one, shape (P,): `closure` sees to that.

    Args:
        scene: Where it happens.
        world: The scene as one plain tree.
        trajectory: The motion.
        dist_safe: Clearance to keep at the waypoints [m].
        touching: Which pairs of geometries of `world.collision` (smaller index first) need no clearance, and the overlap
            of each that counts as contact [m].
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
        self.carried = {name for name, placed in scene.objects.items() if placed.object.free and name in held}
        for name in self.carried:
            for joint in world.joints_of(name):
                self.moved[joint] = True
        robots = len(scene.robot.collision.geometryObjects)
        self._robot_pairs = {frozenset((p.first, p.second)) for p in scene.robot.collision.collisionPairs}
        shapes, labels = world.collision.geometryObjects, world.collision_labels
        self.group = ["robot" if i < robots else self._owner(labels[i]) for i in range(len(shapes))]
        pairs, margins, contact = [], [], []
        for j in range(len(shapes)):
            for i in range(j):
                if self._counts(i, j):
                    pairs.append((i, j))
                    margins.append(0.0 if (i, j) in touching else dist_safe)
                    contact.append(touching.get((i, j), 0.0))
        holders = {(link, owner) for phase in trajectory.phases for owner, link in phase.by.items()}
        names = [((labels[i], self.group[j]), (labels[j], self.group[i])) for i, j in pairs]
        by_hand = [margin == 0.0 and overlap == 0.0 for margin, overlap in zip(margins, contact, strict=True)]
        self.together = np.array(by_hand) | np.array([bool(holders.intersection(both)) for both in names], bool)
        if not pairs:
            raise InputError("no pair of geometries can collide", field="scene", expected="collision geometry")
        self.pairs, self.margins, self.contact = np.array(pairs), np.array(margins), np.array(contact)
        self.geometry = world.collision.copy()
        self.geometry.removeAllCollisionPairs()
        for first, second in pairs:
            self.geometry.addCollisionPair(pin.CollisionPair(first, second))
        if len(self.geometry.collisionPairs) != len(pairs):
            raise InputError("collision pairs were lost", expected=len(pairs), got=len(self.geometry.collisionPairs))

    def _owner(self, label: str) -> str:
        owner = label.partition(".")[0]
        return owner if owner in self.scene.objects and "." in label else ""

    def _counts(self, i: int, j: int) -> bool:
        """Return whether geometries i < j (robot first, then objects, then obstacles) can collide at all."""
        shapes, a, b = self.world.collision.geometryObjects, self.group[i], self.group[j]
        if a == "robot" and b == "robot":
            return frozenset((i, j)) in self._robot_pairs
        if self.world.collision_labels[j] == FLOOR:  # wheels stand on it, objects hang as their makers hung them
            return (a == "robot" and shapes[i].parentJoint > 1) or a in self.carried
        if a == "robot":
            return True
        if a == b:  # an object with itself, or two obstacles
            return False
        return self.moved[shapes[i].parentJoint] or self.moved[shapes[j].parentJoint]

    def sweep(self, z: NDArray[np.float64], waypoints: NDArray[np.int_]) -> Iterator[Hit]:
        """Yield what is close along the motion, and at least the closest pair of every waypoint.

        Args:
            z: Sampled configurations of the world, shape (S, n), evenly spaced between waypoints.
            waypoints: Rows of `z` that are waypoints, shape (T,).
        """
        model, data = self.world.model, self.world.model.createData()
        shapes = pin.GeometryData(self.geometry)
        at = np.empty((len(waypoints), len(self.pairs)))
        for t, q in enumerate(self.world.coordinates.q(z[waypoints])):
            pin.updateGeometryPlacements(model, data, self.geometry, shapes, q)
            pin.computeDistances(self.geometry, shapes)
            at[t] = [result.min_distance for result in shapes.distanceResults]
        for t, row in enumerate(waypoints.tolist()):
            for k in {int(np.argmin(at[t])), *np.flatnonzero(at[t] < self.margins).tolist()}:
                yield self._hit(row, k, at[t, k], at_waypoint=True)
        bounds = self._motion_bounds(z, waypoints)
        motion = bounds[:, self.pairs[:, 0]] + bounds[:, self.pairs[:, 1]]
        # d(s) ≥ (d_t + d_{t+1} − relative motion) / 2 for every state in between.
        floor = (at[1:] + at[:-1] - motion) / 2
        smallest = max(1e-3, float(at.min()))  # what cannot come closer than that changes nothing
        for t in np.flatnonzero((floor < smallest).any(axis=1)).tolist():
            active = np.flatnonzero(floor[t] < smallest)
            first, last = int(waypoints[t]), int(waypoints[t + 1])
            rows = np.empty((last - first + 1, len(active)))
            rows[0], rows[-1] = at[t, active], at[t + 1, active]
            for row in range(first + 1, last):
                rows[row - first] = self._distances(self.world.coordinates.q(z[row]), active, data, shapes)
                closest = int(np.argmin(rows[row - first]))
                for c in {closest, *np.flatnonzero(rows[row - first] < 0).tolist()}:
                    yield self._hit(row, active[c], rows[row - first, c])
            # Between two samples that are free it is looked at again and again, until nothing deeper than 1 mm can hide.
            step = motion[t, active] / (last - first)
            overlap = self.contact[active]
            free = (np.minimum(rows[1:], rows[:-1]) >= -overlap) & (rows[1:] + rows[:-1] < step)
            for r, c in np.argwhere(free & ~self.together[active]):
                stack = [(0.0, 1.0, rows[r, c], rows[r + 1, c])]
                while stack:
                    low, high, before, after = stack.pop()
                    if (width := (high - low) * step[c]) <= 2 * RESOLUTION or before + after >= width:
                        continue
                    middle = (low + high) / 2
                    state = self.world.coordinates.q((1 - middle) * z[first + r] + middle * z[first + r + 1])
                    (between,) = self._distances(state, active[c : c + 1], data, shapes)
                    yield self._hit(first + r, active[c], between)
                    if between < -overlap[c]:
                        break
                    stack += [(low, middle, before, between), (middle, high, between, after)]

    def _distances(
        self, q: NDArray[np.float64], pairs: NDArray[np.int_], data: pin.Data, shapes: pin.GeometryData
    ) -> NDArray[np.float64]:
        """Return the distances of some pairs at one configuration [m]."""
        pin.updateGeometryPlacements(self.world.model, data, self.geometry, shapes, q)
        return np.array([pin.computeDistance(self.geometry, shapes, int(k)).min_distance for k in pairs])

    def _hit(self, row: int, k: int, distance: float, *, at_waypoint: bool = False) -> Hit:
        first, second = self.pairs[k]
        labels = self.world.collision_labels
        return Hit(
            int(row), labels[first], labels[second], float(distance), float(self.margins[k]), float(self.contact[k]), at_waypoint
        )

    def _motion_bounds(self, samples: NDArray[np.float64], waypoints: NDArray[np.int_]) -> NDArray[np.float64]:
        """Return how far any point of each geometry can move between waypoints, shape (T − 1, G) [m].

        A joint's rotation moves a point by at most the angle times its distance from the axis, and that is at most the
        sum of the offsets of all joints between, and of the geometry itself; a prismatic joint adds its travel. The way of
        a free joint is the sum over the samples in between.
        """
        model, coordinates, z = self.world.model, self.world.coordinates, samples[waypoints]
        steps = np.abs(np.diff(z, axis=0))
        spans = np.linalg.norm(np.diff(z[:, :2], axis=0), axis=1)
        offset = [float(np.linalg.norm(placement.translation)) for placement in model.jointPlacements]
        of_joint: dict[int, list[int]] = {}
        for index, joint in enumerate(coordinates.joints):
            of_joint.setdefault(joint, []).append(index)
        prismatic = {j: model.joints[j].shortname().startswith("JointModelP") and j > 1 for j in of_joint}
        bounds = np.zeros((len(steps), len(self.geometry.geometryObjects)))
        for g, shape in enumerate(self.geometry.geometryObjects):
            center, half = bounding_box(shape)
            reach = float(np.linalg.norm(half)) + float(np.linalg.norm(shape.placement.act(center)))
            joint = shape.parentJoint
            while joint:
                columns = of_joint[joint]
                if len(columns) == 7:  # the free joint of what can be carried
                    bounds[:, g] += self._free_motion(samples[:, columns], waypoints, reach)
                elif len(columns) == 3:  # the planar base
                    bounds[:, g] += spans + steps[:, columns[2]] * reach
                elif prismatic[joint]:
                    bounds[:, g] += steps[:, columns[0]]
                    reach += float(np.abs(z[:, columns[0]]).max())
                else:
                    bounds[:, g] += steps[:, columns[0]] * reach
                reach += offset[joint]
                joint = model.parents[joint]
        return bounds

    def _free_motion(self, samples: NDArray[np.float64], waypoints: NDArray[np.int_], reach: float) -> NDArray[np.float64]:
        """Return how far a point at `reach` [m] from a free joint moves between waypoints, shape (T − 1,) [m]."""
        turns = samples[:, 3:] / np.linalg.norm(samples[:, 3:], axis=1, keepdims=True)
        half = np.arccos(np.clip(np.abs(np.einsum("kc,kc->k", turns[1:], turns[:-1])), 0.0, 1.0))
        way = np.linalg.norm(np.diff(samples[:, :3], axis=0), axis=1) + 2.0 * half * reach
        total = np.concatenate([[0.0], np.cumsum(way)])
        return np.diff(total[waypoints])
