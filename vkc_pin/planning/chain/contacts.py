"""Computes signed distances of collision pairs and witness planes, linearising eqs. 6 and 7.

For a pair (A, B) coal gives witness points a, b and the normal n of the distance n·(b − a). With a
fixed in A, b in B and n in the world, n·(b(z) − a(z)) has the distance's value and gradient, and is
linear in the joint placements: C·vec(M(z)) − R.
"""

from __future__ import annotations

import copy
import dataclasses
import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin.options import Options
from vkc_pin.planning.chain.chain import VirtualKinematicChain
from vkc_pin.planning.chain.collision_pairs import PhaseGeometry, build_phase_geometries
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.utils.budget import record_evaluations
from vkc_pin.world.collision.distances import Clearances, Shapes
from vkc_pin.world.collision.solids import ShapePlacements
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.phases import Task

# Tolerance of coal's distances. With coal's default of 1e-6, plane gradients have errors of up to
# 5e-3; this value takes no longer.
_DISTANCE_TOLERANCE = 1e-8
_KINEMATICS_BATCH = 256  # configurations per kinematics evaluation


@dataclass(frozen=True, eq=False)
class Contacts:
    """Close pairs at waypoints; arrays over C contacts, nearest first within a waypoint.

    Attributes:
        waypoint: Row of the configuration, shape (C,).
        pair: Geometry indices, shape (C, 2).
        distance, margin: Signed distance and required clearance, shape (C,) [m].
        normal: Unit normal from the first to the second in the world, shape (C, 3).
        first, second: Witness points in the world, shape (C, 3) [m].
    """

    waypoint: Ints
    pair: Ints
    distance: Floats
    margin: Floats
    normal: Floats
    first: Floats
    second: Floats

    def arrays(self) -> tuple[NDArray[Any], ...]:
        """Return the arrays in the order of the attributes."""
        return tuple(getattr(self, field.name) for field in dataclasses.fields(self))

    def select(self, index: Ints) -> Contacts:
        """Return the contacts at `index`, in that order."""
        return Contacts(*(array[index] for array in self.arrays()))

    @property
    def slot(self) -> Ints:
        """Rank of each contact within its waypoint, from 0, shape (C,)."""
        return np.arange(len(self.waypoint)) - np.searchsorted(self.waypoint, self.waypoint)

    def compute_violation(self) -> float:
        """Return the largest margin shortfall [m]; 0 if all pairs keep their margins."""
        return float(max(0.0, np.max(self.margin - self.distance, initial=0.0)))

    def compute_shortfall(self, segments: int) -> Floats:
        """Return the largest margin shortfall per configuration, shape (segments,) [m]."""
        worst = np.zeros(segments)
        np.maximum.at(worst, self.waypoint, self.margin - self.distance)
        return worst

    def compute_clearance(self) -> float:
        """Return the smallest distance [m]; infinite if there are no contacts."""
        return float(np.min(self.distance, initial=np.inf))


def make_empty_contacts() -> Contacts:
    """Return an empty set of contacts."""
    none, vectors = np.zeros(0), np.zeros((0, 3))
    return Contacts(np.zeros(0, int), np.zeros((0, 2), int), none, none, vectors, vectors, vectors)


class ContactModel:
    """Collision pairs and distances in each phase of a task.

    Attributes:
        phases: Geometry and pairs of each phase.
        first_waypoint: Waypoint at which each phase starts.
    """

    def __init__(
        self, scene: Scene, chain: VirtualKinematicChain, task: Task, options: Options
    ) -> None:
        self.scene, self.chain, self.task = scene, chain, task
        self.first_waypoint = np.concatenate(
            [[0], np.cumsum([phase.segments for phase in task.phases])]
        )
        placed = {
            opening: ShapePlacements(chain.model, chain.get_collision_geometry(opening))
            for opening in dict.fromkeys(phase.opening for phase in task.phases)
        }
        self.phases = build_phase_geometries(scene, chain, task, options)
        self._clearances = [
            self._make_clearances(part, placed[phase.opening])
            for part, phase in zip(self.phases, task.phases, strict=True)
        ]
        own = [shape.parentJoint for shape in chain.collision.geometryObjects]
        n_fixed = max(len(part.labels) for part in self.phases) - len(own)
        self._joints = np.array(own + [0] * n_fixed)

    def _make_clearances(self, part: PhaseGeometry, placed: ShapePlacements) -> Clearances:
        moving = len(self.chain.collision.geometryObjects)
        standing = [shape.placement for shape in part.shapes[moving:]]
        shapes = Shapes(
            [shape.geometry for shape in part.shapes], standing, tolerance=_DISTANCE_TOLERANCE
        )
        return Clearances(placed, part.boxes, shapes, part.margin_table)

    def with_released_objects(self, z: Floats) -> ContactModel:
        """Return a copy with released objects where the motion z_1..z_N, shape (N, n), puts them.

        In the original they are where the task expects them, which is only approximate if the
        motion chooses the placement itself.
        """
        if not any(phase.released_by for phase in self.task.phases):
            return self
        view = copy.copy(self)
        view.phases, view._clearances = list(self.phases), list(self._clearances)
        for number, phase in enumerate(self.task.phases):
            where: dict[int, pin.SE3] = {}
            for name, (hold, before) in phase.released_by.items():
                closure = self.chain.closures[hold]
                rotations, translations = self.chain.joint_placements(
                    z[[self.first_waypoint[before + 1] - 1]]
                )
                carrier = pin.SE3(rotations[0, closure.joint], translations[0, closure.joint])
                placed = dataclasses.replace(
                    self.scene.objects[name], placement=carrier * closure.local
                )
                placements = [shape.placement for shape in make_world_shapes(placed)]
                where |= zip(self.phases[number].released[name], placements, strict=True)
            if where:
                view.phases[number] = part = self.phases[number].with_placements(where)
                view._clearances[number] = self._clearances[number].move_fixed(part.boxes, where)
        return view

    def find_attached_geometries(self, phase: int) -> list[int]:
        """Return the geometries of grasped objects in a phase and of objects supported by them."""
        held, supported = self.task.phases[phase].held, self.task.phases[phase].supported
        found = [self.chain.held_geometries[hold] for hold in held]
        return [*itertools.chain(*found, *(self.chain.ride_geometries[ride] for ride in supported))]

    def find_phase(self, waypoint: int) -> int:
        """Return the phase of a waypoint: at a boundary the earlier one, before the grasp."""
        return max(int(self.first_waypoint.searchsorted(waypoint)) - 1, 0)

    def find_phases(self, waypoints: Ints) -> Ints:
        """Return the phase of each waypoint, shape (W,), see `find_phase`."""
        return np.maximum(np.searchsorted(self.first_waypoint, waypoints) - 1, 0)

    def find_waypoint(self, phase: int) -> int:
        """Return a waypoint that belongs to a phase."""
        return int(self.first_waypoint[phase]) + 1

    def evaluate(
        self,
        z: Floats,
        waypoints: Ints,
        *,
        reach: float,
        nearest: int | None = None,
        static: bool = True,
    ) -> Contacts:
        """Return the pairs closer than `reach` [m].

        Args:
            z: Configurations, shape (W, n).
            waypoints: Waypoint whose phase each configuration belongs to, shape (W,).
            reach: Pairs further apart are omitted [m].
            nearest: Maximum number of pairs per configuration, those with the largest shortfall.
                Defaults to all.
            static: Whether pairs with geometry fixed in the world count; otherwise only pairs of
                two moving geometries.
        """
        record_evaluations(len(z))
        q, phase_of = self.chain.coordinates.q(z), self.find_phases(waypoints)
        parts: list[tuple[NDArray[Any], ...]] = []
        for number in dict.fromkeys(phase_of.tolist()):
            members = np.flatnonzero(phase_of == number)
            queries = (
                (q, z, waypoints)
                if len(members) == len(z)
                else (q[members], z[members], waypoints[members])
            )
            found = self._clearances[number].find_closest_pairs(
                *queries, reach=reach, max_pairs=nearest, include_fixed=static
            )
            pairs = self.phases[number].pairs[found.pair]
            parts.append((members[found.row], pairs, *found[2:]))
        if len(parts) == 1:
            return Contacts(*parts[0])
        if not parts:
            return make_empty_contacts()
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        return Contacts(*columns).select(np.argsort(columns[0], kind="stable"))

    def count_free(
        self, z: Floats, edges: Ints, waypoint: int, *, reach: float, allowed: float
    ) -> Ints:
        """Return how many configurations of each run precede the first collision, shape (R,).

        Each run is evaluated up to its first collision only.

        Args:
            z: Configurations, shape (W, n).
            edges: Index of the first configuration of each run, and the end of the last, (R + 1,).
            waypoint: Waypoint whose phase all of them belong to.
            reach: Pairs further apart are ignored [m].
            allowed: Allowed margin shortfall [m].
        """
        clearances = self._clearances[self.find_phase(waypoint)]
        q = self.chain.coordinates.q(z)
        free = clearances.count_free(q, z, edges, waypoint, reach=reach, allowed=allowed)
        record_evaluations(int(np.minimum(free + 1, np.diff(edges)).sum()))
        return free

    def compute_placements(self, z: Floats) -> tuple[Floats, Floats]:
        """Return the chain's `joint_placements`, evaluated in batches of one size.

        CasADi prepares a function anew for each batch size.
        """
        parts = [
            self.chain.joint_placements(z[row : row + _KINEMATICS_BATCH])
            for row in range(0, max(len(z), 1), _KINEMATICS_BATCH)
        ]
        rotations, translations = map(np.concatenate, zip(*parts, strict=True))
        return rotations, translations

    def get_joints(self, geometries: Ints) -> Ints:
        """Return the chain's joints that carry `geometries`; 0 for geometry fixed in the world."""
        return self._joints[geometries]

    def compute_gradients(self, z: Floats, contacts: Contacts) -> Floats:
        """Return the distance gradients n·(∂b − ∂a) of contacts at `z`, shape (C, n)."""
        joints = self.get_joints(contacts.pair)
        which = np.tile(contacts.waypoint, 2)
        points = np.concatenate([contacts.first, contacts.second])
        first, second = np.split(self.chain.point_jacobians(z, which, joints.T.ravel(), points), 2)
        return np.asarray(np.einsum("ci,cij->cj", contacts.normal, second - first))

    def compute_normals(self, z: Floats, waypoints: Ints, pairs: Ints) -> Floats:
        """Return the normal, from first to second, of one pair per configuration, shape (B, 3)."""
        found, phase_of = np.empty((len(z), 3)), self.find_phases(waypoints)
        for number in set(phase_of.tolist()):
            members = np.flatnonzero(phase_of == number)
            clearances, rows = self._clearances[number], np.arange(len(members))
            q = self.chain.coordinates.q(z[members])
            where = clearances.placements.compute_placements(q)
            found[members] = clearances.shapes.compute_witnesses(where, rows, pairs[members]).normal
        return found

    def compute_planes(self, z: Floats, contacts: Contacts, *, slots: int) -> tuple[Floats, Floats]:
        """Return the witness planes of the nearest contacts, C·vec(M(z)) − R ≥ 0.

        A plane states that its contact keeps the margin; M are the placements of all joints. Unused
        slots have C = 0, R = −1.

        Args:
            z: Configurations, shape (W, n).
            contacts: Contacts at these configurations.
            slots: Planes per configuration; further contacts are ignored.

        Returns:
            C, shape (W, slots, 12·joints), and R, shape (W, slots).
        """
        joints = self.chain.model.njoints - 1
        # for each joint the columns of R, then t
        coefficients = np.zeros((len(z), slots, joints, 4, 3))
        offsets = np.full((len(z), slots), -1.0)
        place = contacts.slot
        keep = np.flatnonzero(place < slots)
        row, slot, normal = contacts.waypoint[keep], place[keep], contacts.normal[keep]
        offset = contacts.margin[keep].copy()
        rotations, translations = self.chain.joint_placements(z)
        for column, points, sign in ((0, contacts.first, -1.0), (1, contacts.second, 1.0)):
            points = points[keep]
            joint = self._joints[contacts.pair[keep, column]]
            is_static = joint == 0
            offset[is_static] -= sign * np.einsum("ci,ci->c", normal[is_static], points[is_static])
            r, s, j, n = row[~is_static], slot[~is_static], joint[~is_static], normal[~is_static]
            local = np.einsum(
                "cij,ci->cj", rotations[r, j], points[~is_static] - translations[r, j]
            )
            coefficients[r, s, j - 1, :3] += sign * local[:, :, None] * n[:, None, :]
            coefficients[r, s, j - 1, 3] += sign * n
        offsets[row, slot] = offset
        return coefficients.reshape(len(z), slots, 12 * joints), offsets
