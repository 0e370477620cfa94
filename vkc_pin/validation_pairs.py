"""Every pair that could collide along a motion, and its distance at every state that matters.

A pair is left out of a stretch between two waypoints only where it cannot come close: the distance of two bodies changes
by at most what their relative motion is long.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
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
    """A pair's distance [m] at one state: at sample `row`, or between it and the next."""

    row: int
    first: str
    second: str
    distance: float
    margin: float
    at_waypoint: bool


class PairTable:
    """All pairs of a motion.

    Attributes:
        pairs: Geometry indices in `world.collision`, shape (P, 2).
        margins: Clearance each must keep at waypoints [m], shape (P,); 0 where a gripper closes on what it grasps.

    Args:
        scene: Where it happens.
        world: The scene as one plain tree.
        trajectory: The motion; what it holds at any time its gripper may touch.
        dist_safe: Clearance to keep at the waypoints [m].
        grasps: Objects and attachments that the gripper may touch besides.
    """

    def __init__(
        self,
        scene: Scene,
        world: World,
        trajectory: Trajectory,
        dist_safe: float,
        *,
        grasps: Iterable[tuple[str, str]] = (),
    ) -> None:
        self.scene, self.world, self.dist_safe = scene, world, dist_safe
        self.moved = [False]  # for each joint of the world, whether the trajectory moves it or one that carries it
        for joint in range(1, world.model.njoints):
            self.moved.append(self.moved[world.model.parents[joint]] or world.model.names[joint] in trajectory.names)
        self.grasped = {
            f"{owner}.{scene.objects[owner].object.attachments[attachment].link}"
            for owner, attachment in itertools.chain(
                grasps, scene.held.items(), *(phase.held.items() for phase in trajectory.phases)
            )
        }
        robots = len(scene.robot.collision.geometryObjects)
        self._robot_pairs = {frozenset((p.first, p.second)) for p in scene.robot.collision.collisionPairs}
        shapes, labels = world.collision.geometryObjects, world.collision_labels
        self.group = ["robot" if i < robots else self._owner(labels[i]) for i in range(len(shapes))]
        pairs, margins = [], []
        for j in range(len(shapes)):
            for i in range(j):
                if self._counts(i, j):
                    touch = labels[i] in scene.robot.touch_links and labels[j] in self.grasped
                    pairs.append((i, j))
                    margins.append(0.0 if touch else dist_safe)
        if not pairs:
            raise InputError("no pair of geometries can collide", field="scene", expected="collision geometry")
        self.pairs, self.margins = np.array(pairs), np.array(margins)
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
            return a == "robot" and shapes[i].parentJoint > 1
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
        bounds = self._motion_bounds(z[waypoints])
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
            free = (np.minimum(rows[1:], rows[:-1]) >= 0) & (rows[1:] + rows[:-1] < step)
            alone = self.margins[active] > 0  # a hand that holds something moves along with it: `closure` sees to that
            for r, c in np.argwhere(free & alone):
                stack = [(0.0, 1.0, rows[r, c], rows[r + 1, c])]
                while stack:
                    low, high, before, after = stack.pop()
                    if (width := (high - low) * step[c]) <= 2 * RESOLUTION or before + after >= width:
                        continue
                    middle = (low + high) / 2
                    state = self.world.coordinates.q((1 - middle) * z[first + r] + middle * z[first + r + 1])
                    (between,) = self._distances(state, active[c : c + 1], data, shapes)
                    yield self._hit(first + r, active[c], between)
                    if between < 0:
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
        return Hit(int(row), labels[first], labels[second], float(distance), float(self.margins[k]), at_waypoint)

    def _motion_bounds(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far any point of each geometry can move between waypoints, shape (T − 1, G) [m].

        A joint's rotation moves a point by at most the angle times its distance from the axis, and that is at most the
        sum of the offsets of all joints between, and of the geometry itself; a prismatic joint adds its travel.
        """
        model, coordinates = self.world.model, self.world.coordinates
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
                if len(columns) == 3:  # the planar base
                    bounds[:, g] += spans + steps[:, columns[2]] * reach
                elif prismatic[joint]:
                    bounds[:, g] += steps[:, columns[0]]
                    reach += float(np.abs(z[:, columns[0]]).max())
                else:
                    bounds[:, g] += steps[:, columns[0]] * reach
                reach += offset[joint]
                joint = model.parents[joint]
        return bounds
