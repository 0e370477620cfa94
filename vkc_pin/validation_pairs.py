"""Every pair that could collide along a motion, and its distance at every state that matters.

A pair is left out of a stretch between two waypoints only where it cannot come close: the distance of two bodies changes
by at most what their relative motion is long.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin.errors import InputError
from vkc_pin.scene import FLOOR, Scene
from vkc_pin.trajectory import Trajectory
from vkc_pin.world import World

__all__ = ["Hit", "PairTable"]


class Hit(NamedTuple):
    """A pair's distance at one state."""

    row: int
    first: str
    second: str
    distance: float
    margin: float


class PairTable:
    """All pairs of a motion.

    Attributes:
        pairs: Geometry indices in `world.collision`, shape (P, 2).
        margins: Clearance each must keep at waypoints [m], shape (P,); 0 where a gripper closes on what it grasps.
    """

    def __init__(self, scene: Scene, world: World, trajectory: Trajectory, dist_safe: float) -> None:
        self.scene, self.world, self.dist_safe = scene, world, dist_safe
        self.moved = {name.partition(".")[0] for name in trajectory.names} & set(scene.objects)
        self.grasped = {
            f"{owner}.{scene.objects[owner].object.attachments[attachment].link}"
            for phase in trajectory.phases
            for owner, attachment in phase.held.items()
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
        moving = (a in self.moved and shapes[i].parentJoint > 0) or (b in self.moved and shapes[j].parentJoint > 0)
        return moving

    def sweep(self, z: NDArray[np.float64], waypoints: NDArray[np.int_]) -> Iterator[Hit]:
        """Yield what is close along the motion, and at least the closest pair of every waypoint.

        Args:
            z: Sampled configurations of the world, shape (S, n).
            waypoints: Rows of `z` that are waypoints, shape (T,).
        """
        model, data = self.world.model, self.world.model.createData()
        shapes = pin.GeometryData(self.geometry)
        q = self.world.coordinates.q(z)
        at = np.empty((len(waypoints), len(self.pairs)))
        for t, row in enumerate(waypoints):
            pin.updateGeometryPlacements(model, data, self.geometry, shapes, q[row])
            pin.computeDistances(self.geometry, shapes)
            at[t] = [result.min_distance for result in shapes.distanceResults]
        for t, row in enumerate(waypoints):
            closest = int(np.argmin(at[t]))
            for k in {closest, *np.flatnonzero(at[t] < self.margins)}:
                yield self._hit(int(row), int(k), at[t, k])
        motion = self._motion_bounds(z[waypoints])
        # d(s) ≥ (d_t + d_{t+1} − relative motion) / 2 for every state in between.
        floor = (at[1:] + at[:-1] - motion[:, self.pairs].sum(axis=2)) / 2
        smallest = max(1e-3, float(at.min()))  # what cannot come closer than that changes nothing
        for t in range(len(waypoints) - 1):
            active = np.flatnonzero(floor[t] < smallest)
            inside = range(waypoints[t] + 1, waypoints[t + 1])
            if not len(active) or not len(inside):
                continue
            shapes.deactivateAllCollisionPairs()
            for k in active:
                shapes.activateCollisionPair(int(k))
            for row in inside:
                pin.updateGeometryPlacements(model, data, self.geometry, shapes, q[row])
                closest = pin.computeDistances(self.geometry, shapes)
                distance = shapes.distanceResults[closest].min_distance
                if distance >= 0:
                    yield self._hit(row, closest, distance)
                    continue
                for k in active:
                    if shapes.distanceResults[int(k)].min_distance < 0:
                        yield self._hit(row, int(k), shapes.distanceResults[int(k)].min_distance)

    def _hit(self, row: int, k: int, distance: float) -> Hit:
        first, second = self.pairs[k]
        labels = self.world.collision_labels
        return Hit(row, labels[first], labels[second], float(distance), float(self.margins[k]))

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
            shape.geometry.computeLocalAABB()
            box = shape.geometry.aabb_local
            radius = float(np.linalg.norm([box.width(), box.height(), box.depth()])) / 2
            reach = radius + float(np.linalg.norm(shape.placement.act(np.asarray(box.center()))))
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
