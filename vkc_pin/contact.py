"""Collision pairs, signed distances (coal) and witness planes.

For a pair (A, B) coal gives the witness points a, b and the normal n of the signed distance d = n·(b − a). With a
fixed in A's body, b in B's and n in the world, n·(b(z) − a(z)) is smooth in z, and its value and gradient equal the
signed distance's at the linearisation point. It is linear in the placements of the joints, C·vec(M(z)) − R.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin.assembly import graft_geometry
from vkc_pin.chain import VirtualKinematicChain
from vkc_pin.errors import InputError
from vkc_pin.goal import Phase, Task
from vkc_pin.options import Options
from vkc_pin.scene import Scene, standing_geometry

__all__ = ["ContactModel", "Contacts"]


@dataclass(frozen=True)
class Contacts:
    """Close pairs at waypoints; arrays over C contacts, nearest first within a waypoint.

    Attributes:
        waypoint: Row of the configurations it belongs to, shape (C,).
        pair: Geometry indices, shape (C, 2).
        distance: Signed distance [m], shape (C,).
        margin: Clearance the pair must keep [m], shape (C,).
        normal: From the first to the second, world frame, shape (C, 3).
        first, second: Witness points in the world, shape (C, 3) [m].
    """

    waypoint: NDArray[np.int_]
    pair: NDArray[np.int_]
    distance: NDArray[np.float64]
    margin: NDArray[np.float64]
    normal: NDArray[np.float64]
    first: NDArray[np.float64]
    second: NDArray[np.float64]

    def violation(self) -> float:
        """Return by how much the worst pair falls short of its margin [m]; 0 if none does."""
        return float(max(0.0, np.max(self.margin - self.distance, initial=0.0)))

    def clearance(self) -> float:
        """Return the smallest distance [m]; infinite if nothing is close."""
        return float(np.min(self.distance, initial=np.inf))


@dataclass(frozen=True)
class PhaseGeometry:
    """Geometry and pairs of one phase.

    Attributes:
        geometry: Robot, held links, then what stands in the world (parent joint 0).
        labels: Per geometry, its link or obstacle, e.g. "wrist_3_link", "door.panel", "sofa".
        pairs: Shape (P, 2).
        margins: Clearance each pair must keep, shape (P,) [m].
    """

    geometry: pin.GeometryModel
    data: pin.GeometryData
    labels: tuple[str, ...]
    pairs: NDArray[np.int_]
    margins: NDArray[np.float64]


class ContactModel:
    """What can collide with what in each phase of a task, and how close it is.

    Attributes:
        phases: Geometry and pairs per phase.
        first_waypoint: Waypoint at which each phase starts.
    """

    def __init__(self, scene: Scene, chain: VirtualKinematicChain, task: Task, options: Options) -> None:
        self.scene, self.chain, self.options = scene, chain, options
        self.data = chain.model.createData()
        self.phases = [self._phase(phase) for phase in task.phases]
        self.first_waypoint = np.concatenate([[0], np.cumsum([phase.segments for phase in task.phases])])

    def _phase(self, phase: Phase) -> PhaseGeometry:
        scene, chain, robot, margin = self.scene, self.chain, self.scene.robot, self.options.dist_safe
        geometry = chain.collision.copy()
        geometry.removeAllCollisionPairs()
        robots = range(len(robot.collision.geometryObjects))
        labels = [robot.link_of(i) for i in robots]
        for name, indices in chain.held_geometries.items():
            labels += [f"{name}.{_link(geometry.geometryObjects[i])}" for i in indices]
        pairs = [(pair.first, pair.second, margin) for pair in robot.collision.collisionPairs]
        touching = {i for i in robots if labels[i] in robot.touch_links}
        moving = list(robots)
        for name, attachment in phase.held.items():
            grasped = f"{name}.{scene.objects[name].object.attachments[attachment].link}"
            held = chain.held_geometries[name]
            # The hand and what it grasps move rigidly together: nothing to plan there.
            pairs += [(i, j, margin) for i in robots for j in held if not (i in touching and labels[j] == grasped)]
            moving += held
        for name, placed in scene.objects.items():
            before = {c.removeprefix(f"{name}."): v for c, v in phase.before.items() if c.startswith(f"{name}.")}
            standing = standing_geometry(placed.with_state(before))
            if name in phase.held:  # its frame stands on, the rest is in the hand
                originals = placed.object.collision.geometryObjects
                standing = [g for g, original in zip(standing, originals, strict=True) if original.parentJoint == 0]
            own = chain.held_geometries[name] if name in phase.held else ()
            target = placed.object.attachments[phase.grasps[name]].link if name in phase.grasps else None
            for j in graft_geometry(geometry, standing, joints=[0], placement=pin.SE3.Identity(), prefix=f"{name}."):
                link = _link(geometry.geometryObjects[j])
                labels.append(f"{name}.{link}")
                near = touching if link == target else set()
                pairs += [(i, j, self.options.grasp_clearance if i in near else margin) for i in moving if i not in own]
        for obstacle, label in zip(scene.obstacles.geometryObjects, scene.obstacle_labels, strict=True):
            (j,) = graft_geometry(geometry, [obstacle], joints=[0], placement=pin.SE3.Identity())
            labels.append(label)
            # Wheels stand on the floor, and doors hang above it as their makers hung them.
            moves = [i for i in moving if label != FLOOR or (i in robots and geometry.geometryObjects[i].parentJoint > 1)]
            pairs += [(i, j, margin) for i in moves]
        if not pairs:
            raise InputError("no pair of geometries can collide", field=phase.name, expected="collision geometry in robot or scene")
        for first, second, _ in pairs:
            geometry.addCollisionPair(pin.CollisionPair(first, second))
        if len(geometry.collisionPairs) != len(pairs):
            raise InputError("collision pairs were lost", field=phase.name, expected=len(pairs), got=len(geometry.collisionPairs))
        table, margins = np.array([p[:2] for p in pairs]), np.array([p[2] for p in pairs])
        return PhaseGeometry(geometry, pin.GeometryData(geometry), tuple(labels), table, margins)

    def phase_of(self, waypoint: int) -> int:
        """Return the phase whose geometry holds at `waypoint`: at a boundary the earlier, before the grasp."""
        return max(0, int(np.searchsorted(self.first_waypoint, waypoint)) - 1)

    def evaluate(self, z: NDArray[np.float64], waypoints: NDArray[np.int_], *, reach: float) -> Contacts:
        """Return all pairs closer than `reach` [m].

        Args:
            z: Configurations, shape (W, n).
            waypoints: For each, the waypoint whose phase it belongs to, shape (W,).
            reach: Pairs further apart are left out.
        """
        q = self.chain.coordinates.q(z)
        rows: list[tuple[int, int, int, float, float]] = []
        vectors: list[tuple[NDArray[np.float64], ...]] = []
        for row, waypoint in enumerate(waypoints):
            part = self.phases[self.phase_of(int(waypoint))]
            pin.updateGeometryPlacements(self.chain.model, self.data, part.geometry, part.data, q[row])
            pin.computeDistances(part.geometry, part.data)
            results = part.data.distanceResults
            near = [(r.min_distance, k) for k, r in enumerate(results) if r.min_distance < reach]
            near.sort(key=lambda item: item[0] - part.margins[item[1]])
            for distance, k in near:
                r = results[k]
                rows.append((row, part.pairs[k, 0], part.pairs[k, 1], distance, part.margins[k]))
                vectors.append((r.normal, r.getNearestPoint1(), r.getNearestPoint2()))
        table = np.array(rows, float).reshape(len(rows), 5)
        stacked = np.array(vectors, float).reshape(len(rows), 3, 3)
        index = table[:, :3].astype(int)
        return Contacts(index[:, 0], index[:, 1:], table[:, 3], table[:, 4], stacked[:, 0], stacked[:, 1], stacked[:, 2])

    def planes(self, z: NDArray[np.float64], contacts: Contacts, *, slots: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the coefficients C, shape (W, slots, 12·joints), and offsets R, shape (W, slots), of the nearest contacts.

        C·vec(M(z)) − R ≥ 0 says that a contact keeps its margin; M are the placements of all joints (see `cpin`). Slots
        that nothing needs have C = 0, R = −1.
        """
        model = self.chain.model
        coefficients = np.zeros((len(z), slots, 12 * (model.njoints - 1)))
        offsets = np.full((len(z), slots), -1.0)
        order = np.arange(len(contacts.waypoint)) - np.searchsorted(contacts.waypoint, contacts.waypoint)
        keep = np.flatnonzero(order < slots)
        q, placed = self.chain.coordinates.q(z), -1
        for c in keep:
            row, slot = contacts.waypoint[c], order[c]
            if row != placed:
                pin.forwardKinematics(model, self.data, q[row])
                placed = row
            normal, offset = contacts.normal[c], contacts.margin[c]
            for index, point, sign in zip(contacts.pair[c], (contacts.first[c], contacts.second[c]), (-1.0, 1.0), strict=True):
                joint = self._joint(index)
                if joint == 0:
                    offset -= sign * normal @ point
                else:
                    local = self.data.oMi[joint].actInv(point)
                    coefficients[row, slot, 12 * (joint - 1) : 12 * joint] += sign * np.concatenate([np.kron(local, normal), normal])
            offsets[row, slot] = offset
        return coefficients, offsets

    def _joint(self, index: int) -> int:
        """Return the joint of geometry `index`; beyond the chain's own geometries everything stands in the world."""
        own = self.chain.collision.geometryObjects
        return int(own[int(index)].parentJoint) if index < len(own) else 0


FLOOR = "floor"


def _link(geometry: pin.GeometryObject) -> str:
    """Return the link's name: Pinocchio calls its geometries `<link>_<number>`."""
    return str(geometry.name).split(".")[-1].rpartition("_")[0]
