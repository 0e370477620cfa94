"""Collision pairs, signed distances (coal) and witness planes.

For a pair (A, B) coal gives the witness points a, b and the normal n of the signed distance d = n·(b − a). With a
fixed in A's body, b in B's and n in the world, n·(b(z) − a(z)) is smooth in z, and its value and gradient equal the
signed distance's at the linearisation point. It is linear in the placements of the joints, C·vec(M(z)) − R.
"""

from __future__ import annotations

import dataclasses
from bisect import insort
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin.broadphase import PhaseGeometry
from vkc_pin.chain import VirtualKinematicChain
from vkc_pin.easing import eased_pairs
from vkc_pin.errors import InputError
from vkc_pin.geometry import bounding_box, link_name, own_name
from vkc_pin.hold import Hold
from vkc_pin.narrowphase import Distances
from vkc_pin.options import Options
from vkc_pin.scene import FLOOR, Scene, standing_geometry
from vkc_pin.task import Task

__all__ = ["ContactModel", "Contacts"]

_ROUNDING = 1e-6  # [m] of coal
_ROWS = 256  # configurations whose kinematics are computed at once


@dataclass(frozen=True, eq=False)
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

    def arrays(self) -> tuple[NDArray[Any], ...]:
        """Return its arrays in the order of the attributes."""
        return (self.waypoint, self.pair, self.distance, self.margin, self.normal, self.first, self.second)

    def select(self, index: NDArray[np.int_]) -> Contacts:
        """Return the contacts at `index`, in that order."""
        return Contacts(*(array[index] for array in self.arrays()))

    def violation(self) -> float:
        """Return by how much the worst pair falls short of its margin [m]; 0 if none does."""
        return float(max(0.0, np.max(self.margin - self.distance, initial=0.0)))

    def shortfall(self, segments: int) -> NDArray[np.float64]:
        """Return by how much the worst pair of each of `segments` configurations falls short [m], shape (segments,)."""
        worst = np.zeros(segments)
        np.maximum.at(worst, self.waypoint, self.margin - self.distance)
        return worst

    def clearance(self) -> float:
        """Return the smallest distance [m]; infinite if nothing is close."""
        return float(np.min(self.distance, initial=np.inf))


class ContactModel:
    """What can collide with what in each phase of a task, and how close it is.

    Attributes:
        phases: Geometry and pairs per phase.
        first_waypoint: Waypoint at which each phase starts.
    """

    def __init__(self, scene: Scene, chain: VirtualKinematicChain, task: Task, options: Options) -> None:
        self.scene, self.chain, self.options = scene, chain, options
        self.data = chain.model.createData()
        self.task = task
        self.first_waypoint = np.concatenate([[0], np.cumsum([phase.segments for phase in task.phases])])
        self._placed = pin.GeometryData(chain.collision)
        self._obstacles = tuple(scene.obstacles.geometryObjects)
        self._boxes = _boxes([*chain.collision.geometryObjects]), _boxes(self._obstacles)
        self.phases = [self._phase(number) for number in range(len(task.phases))]
        self._distances = [Distances(part.shapes, self._placed.oMg) for part in self.phases]
        # Beyond the chain's own geometries everything stands in the world.
        own = [shape.parentJoint for shape in chain.collision.geometryObjects]
        self._joints = np.array(own + [0] * (max(len(part.labels) for part in self.phases) - len(own)))

    def _phase(self, number: int) -> PhaseGeometry:
        phase, before = self.task.phases[number], self.task.phases[number - 1] if number else None
        scene, chain, robot, margin = self.scene, self.chain, self.scene.robot, self.options.dist_safe
        shapes = list(chain.collision.geometryObjects)
        robots, own = range(len(robot.collision.geometryObjects)), len(shapes)
        labels = [robot.link_of(i) for i in robots]
        for hold, indices in chain.held_geometries.items():
            labels += [f"{hold.object}.{link_name(own_name(shapes[i].name))}" for i in indices]
        pairs = [(pair.first, pair.second, margin) for pair in robot.collision.collisionPairs]
        moving = list(robots)
        for hold in phase.held:
            grasped, touching = self._grasped(hold), self._touching(hold)
            held = chain.held_geometries[hold]
            # The hand and what it grasps move together: nothing to plan there.
            pairs += [(i, j, margin) for i in moving for j in held if not (labels[i] in touching and labels[j] == grasped)]
            moving += held
        mine = {hold.object: chain.held_geometries[hold] for hold in phase.held}
        left: dict[str, tuple[int, ...]] = {}
        for name, placed in scene.objects.items():
            state = {c.removeprefix(f"{name}."): v for c, v in phase.before.items() if c.startswith(f"{name}.")}
            if placed.object.free:
                if name in mine:
                    continue
                placed = dataclasses.replace(placed, placement=phase.standing.get(name, placed.placement))
            standing = standing_geometry(placed.with_state(state))
            if name in mine:  # its frame stands on, the rest is in the hand
                held_shapes = {own_name(shapes[i].name) for i in mine[name]}
                standing = [shape for shape in standing if shape.name not in held_shapes]
            near = {  # what is held through something touches it; a hand's fingers are on both sides
                self._grasped(hold): (self._touching(hold), 0.0 if hold.by else self.options.grasp_clearance)
                for hold in (*phase.leaves, *phase.grasps)
                if hold.object == name
            }
            if name in phase.left:
                left[name] = tuple(range(len(shapes), len(shapes) + len(standing)))
            for shape in standing:
                label = f"{name}.{link_name(shape.name)}"
                close, least = near.get(label, ((), margin))
                pairs += [
                    (i, len(shapes), least if labels[i] in close else margin) for i in moving if i not in mine.get(name, ())
                ]
                shape.name = f"{name}.{shape.name}"
                shapes.append(shape)
                labels.append(label)
        carried = {i for hold in phase.held if scene.objects[hold.object].object.free for i in mine[hold.object]}
        above = [i for i in moving if i in carried or (i in robots and shapes[i].parentJoint > 1)]
        table = np.concatenate([np.array(pairs).reshape(-1, 3), self._with_obstacles(len(shapes), moving, above)])
        if not len(table):
            raise InputError(
                "no pair of geometries can collide", field=phase.name, expected="collision geometry in robot or scene"
            )
        boxes = zip(self._boxes[0], _boxes(shapes[own:]), self._boxes[1], strict=True)
        center, half, rotation, translation = (np.concatenate(parts) for parts in boxes)
        shapes += self._obstacles
        part = PhaseGeometry(
            tuple(shapes),
            (*labels, *scene.obstacle_labels),
            pairs=table[:, :2].astype(int),
            margins=table[:, 2],
            joint=np.array([shape.parentJoint for shape in shapes]),
            center=center,
            half=half,
            rotation=rotation,
            translation=translation,
            left=left,
        )
        return dataclasses.replace(part, eased=eased_pairs(scene, chain, phase, part, int(self.first_waypoint[number]), before))

    def _with_obstacles(self, first: int, moving: Sequence[int], above: Sequence[int]) -> NDArray[np.float64]:
        """Return the pairs of what moves with the obstacles, the first of which is geometry `first`, and their margins.

        Of `moving`, only those that are `above` the floor can hit it: wheels stand on it, and doors hang above it as their
        makers hung them.
        """
        ones, others = np.array(moving, int), np.arange(len(self._obstacles))
        floor = np.array([label == FLOOR for label in self.scene.obstacle_labels], bool)
        pairs = np.column_stack([np.tile(ones, len(others)), np.repeat(others, len(ones))])
        pairs = pairs[~floor[pairs[:, 1]] | np.isin(pairs[:, 0], above)]
        return np.column_stack([pairs[:, 0], first + pairs[:, 1], np.full(len(pairs), self.options.dist_safe)])

    def _grasped(self, hold: Hold) -> str:
        """Return the label of the link that a hold takes hold of."""
        return f"{hold.object}.{self.scene.objects[hold.object].object.attachments[hold.attachment].link}"

    def _touching(self, hold: Hold) -> Collection[str]:
        """Return the labels of the links that take hold."""
        return self.scene.robot.touch_links if hold.frame is None else (hold.frame,)

    def settle(self, z: NDArray[np.float64]) -> None:
        """Let what the motion z_1..z_N, shape (N, n), leaves behind at places that it chooses itself stand there."""
        for number, phase in enumerate(self.task.phases):
            for name, (hold, before) in phase.left.items():
                part, closure = self.phases[number], self.chain.closures[hold]
                rotations, translations = self.chain.joint_placements(z[[self.first_waypoint[before + 1] - 1]])
                carrier = pin.SE3(rotations[0, closure.joint], translations[0, closure.joint])
                placed = dataclasses.replace(self.scene.objects[name], placement=carrier * closure.local)
                for index, shape in zip(part.left[name], standing_geometry(placed), strict=True):
                    part.place(index, shape.placement)
                    self._distances[number].forget(index)

    def phase_of(self, waypoint: int) -> int:
        """Return the phase whose geometry holds at `waypoint`: at a boundary the earlier, before the grasp."""
        return max(0, int(np.searchsorted(self.first_waypoint, waypoint)) - 1)

    def inside(self, phase: int) -> int:
        """Return a waypoint at which a phase's geometry holds."""
        return int(self.first_waypoint[phase]) + 1

    def evaluate(
        self,
        z: NDArray[np.float64],
        waypoints: NDArray[np.int_],
        *,
        reach: float,
        nearest: int | None = None,
        standing: bool = True,
    ) -> Contacts:
        """Return the pairs closer than `reach` [m].

        Args:
            z: Configurations, shape (W, n).
            waypoints: For each, the waypoint whose phase it belongs to, shape (W,).
            reach: Pairs further apart are left out.
            nearest: How many of them to return per configuration, those that fall shortest of their margins; None: all.
            standing: Whether what stands in the world counts, too; otherwise only pairs of which both move.
        """
        q = self.chain.coordinates.q(z)
        rotations, translations = self.placements(z)
        phase_of = np.maximum(np.searchsorted(self.first_waypoint, waypoints) - 1, 0)
        rows: list[tuple[float, ...]] = []
        vectors: list[NDArray[np.float64]] = []
        for number in set(phase_of.tolist()):
            part, inside = self.phases[number], np.flatnonzero(phase_of == number)
            at, pairs, bounds = part.maybe_within(reach, rotations[inside], translations[inside], standing=standing)
            margins = part.margins_at(pairs, waypoints[inside[at]])
            least = bounds - margins
            order = np.lexsort((pairs, least, at))
            columns = (pairs, *part.pairs[pairs].T, margins, least)
            pair, first, second, margin, bound = (column[order].tolist() for column in columns)
            edges = np.searchsorted(at, np.arange(len(inside) + 1)).tolist()
            for row, begin, end in zip(inside.tolist(), edges[:-1], edges[1:], strict=True):
                if begin == end:
                    continue
                pin.updateGeometryPlacements(self.chain.model, self.data, self.chain.collision, self._placed, q[row])
                asked = self._distances[number].moved()
                found: list[tuple[float, float, int, int, coal.DistanceResult]] = []
                for i in range(begin, end):
                    if nearest is not None and len(found) >= nearest and bound[i] > found[nearest - 1][0] + _ROUNDING:
                        break  # neither this one nor any after it is among the nearest
                    result = asked.of(first[i], second[i])
                    distance = result.min_distance
                    if distance < reach:
                        insort(found, (distance - margin[i], distance, pair[i], i, result))
                for _, distance, _, i, result in found[:nearest]:
                    rows.append((row, first[i], second[i], distance, margin[i]))
                    vectors += (result.normal.copy(), result.getNearestPoint1(), result.getNearestPoint2())
        table = np.array(rows, float).reshape(len(rows), 5)
        order = np.argsort(table[:, 0], kind="stable")
        table, stacked = table[order], np.array(vectors, float).reshape(len(rows), 3, 3)[order]
        index = table[:, :3].astype(int)
        return Contacts(index[:, 0], index[:, 1:], table[:, 3], table[:, 4], stacked[:, 0], stacked[:, 1], stacked[:, 2])

    def placements(self, z: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the same as the chain's `joint_placements`; in portions of one size, as CasADi prepares for each size anew."""
        parts = [self.chain.joint_placements(z[row : row + _ROWS]) for row in range(0, max(len(z), 1), _ROWS)]
        return np.concatenate([rotations for rotations, _ in parts]), np.concatenate([moves for _, moves in parts])

    def joints_of(self, geometries: NDArray[np.int_]) -> NDArray[np.int_]:
        """Return the joints of the chain that carry `geometries`; 0 for what stands in the world."""
        return self._joints[geometries]

    def planes(
        self, z: NDArray[np.float64], contacts: Contacts, *, slots: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the coefficients C, shape (W, slots, 12·joints), and offsets R, shape (W, slots), of the nearest contacts.

        C·vec(M(z)) − R ≥ 0 says that a contact keeps its margin; M are the placements of all joints (see `cpin`). Slots
        that nothing needs have C = 0, R = −1.
        """
        joints = self.chain.model.njoints - 1
        coefficients = np.zeros((len(z), slots, joints, 4, 3))  # per joint the columns of R, then t
        offsets = np.full((len(z), slots), -1.0)
        order = np.arange(len(contacts.waypoint)) - np.searchsorted(contacts.waypoint, contacts.waypoint)
        keep = np.flatnonzero(order < slots)
        row, slot, normal = contacts.waypoint[keep], order[keep], contacts.normal[keep]
        offset = contacts.margin[keep].copy()
        rotations, translations = self.chain.joint_placements(z)
        for column, points, sign in ((0, contacts.first[keep], -1.0), (1, contacts.second[keep], 1.0)):
            joint = self._joints[contacts.pair[keep, column]]
            still = joint == 0
            offset[still] -= sign * np.einsum("ci,ci->c", normal[still], points[still])
            r, s, j, n = row[~still], slot[~still], joint[~still], normal[~still]
            local = np.einsum("cij,ci->cj", rotations[r, j], points[~still] - translations[r, j])
            coefficients[r, s, j - 1, :3] += sign * local[:, :, None] * n[:, None, :]
            coefficients[r, s, j - 1, 3] += sign * n
        offsets[row, slot] = offset
        return coefficients.reshape(len(z), slots, 12 * joints), offsets


def _boxes(shapes: Sequence[pin.GeometryObject]) -> tuple[NDArray[np.float64], ...]:
    """Return centres and half extents of bounding boxes, and placements as rotations and translations; see `PhaseGeometry`."""
    boxes = [bounding_box(shape) for shape in shapes]
    return (
        np.array([center for center, _ in boxes]).reshape(-1, 3),
        np.array([half for _, half in boxes]).reshape(-1, 3),
        np.array([shape.placement.rotation for shape in shapes]).reshape(-1, 3, 3),
        np.array([shape.placement.translation for shape in shapes]).reshape(-1, 3),
    )
