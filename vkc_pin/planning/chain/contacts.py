"""Computes signed distances of collision pairs and witness planes, linearising eqs. 6 and 7.

For a pair (A, B) coal gives witness points a, b and the normal n of the distance n·(b − a). With a
fixed in A, b in B and n in the world, n·(b(z) − a(z)) has the distance's value and gradient, and is
linear in the joint placements: C·vec(M(z)) − R, see `ContactModel.compute_planes`.
"""

from __future__ import annotations

import copy
import dataclasses
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
from vkc_pin.world.collision.batched_model import BatchedModel
from vkc_pin.world.collision.distances import Clearances, Shapes
from vkc_pin.world.scene.hold import Hold
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
        return Contacts(*[array[index] for array in self.arrays()])

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
    scalars = np.zeros(0)
    vectors = np.zeros((0, 3))
    return Contacts(
        waypoint=np.zeros(0, int),
        pair=np.zeros((0, 2), int),
        distance=scalars,
        margin=scalars,
        normal=vectors,
        first=vectors,
        second=vectors,
    )


class ContactModel:
    """Collision pairs and distances in each phase of a task.

    Attributes:
        phases: Geometry and pairs of each phase.
        first_waypoint: Waypoint at which each phase starts.
    """

    def __init__(
        self, scene: Scene, chain: VirtualKinematicChain, task: Task, options: Options
    ) -> None:
        self.scene = scene
        self.chain = chain
        self.task = task
        segments = [phase.segments for phase in task.phases]
        self.first_waypoint = np.concatenate([[0], np.cumsum(segments)])
        placements_by_opening = dict[float | None, BatchedModel]()
        for phase in task.phases:
            if phase.opening not in placements_by_opening:
                geometry = chain.get_collision_geometry(phase.opening)
                placements_by_opening[phase.opening] = BatchedModel.of_shapes(chain.model, geometry)
        self.phases = build_phase_geometries(scene, chain, task, options)
        self._clearances = [
            self._make_clearances(part, placements_by_opening[phase.opening])
            for part, phase in zip(self.phases, task.phases, strict=True)
        ]
        # Joint of each geometry: those of the chain come first, the others are static.
        joints_of_chain = [shape.parentJoint for shape in chain.collision.geometryObjects]
        geometry_count = max(len(part.labels) for part in self.phases)
        self._joints = np.zeros(geometry_count, int)
        self._joints[: len(joints_of_chain)] = joints_of_chain

    def _make_clearances(self, part: PhaseGeometry, placements: BatchedModel) -> Clearances:
        moving = len(self.chain.collision.geometryObjects)
        geometries = [shape.geometry for shape in part.shapes]
        static_placements = [shape.placement for shape in part.shapes[moving:]]
        shapes = Shapes(geometries, static_placements, tolerance=_DISTANCE_TOLERANCE)
        return Clearances(placements, part.boxes, shapes, part.margin_table)

    def with_released_objects(self, z: Floats) -> ContactModel:
        """Return a copy with released objects where the motion z_1..z_N, shape (N, n), puts them.

        In the original they are where the task expects them, which is only approximate if the
        motion chooses the placement itself.
        """
        if not any(phase.released_by for phase in self.task.phases):
            return self
        view = copy.copy(self)
        view.phases = list(self.phases)
        view._clearances = list(self._clearances)
        for number, phase in enumerate(self.task.phases):
            where: dict[int, pin.SE3] = {}
            for name, (hold, before) in phase.released_by.items():
                release = self.first_waypoint[before + 1] - 1  # row of z
                placement = self._compute_object_placement(z[[release]], hold)
                placed = dataclasses.replace(self.scene.objects[name], placement=placement)
                placements = [shape.placement for shape in make_world_shapes(placed)]
                where |= zip(self.phases[number].released[name], placements, strict=True)
            if where:
                part = self.phases[number].with_placements(where)
                view.phases[number] = part
                view._clearances[number] = self._clearances[number].move_fixed(part.boxes, where)
        return view

    def _compute_object_placement(self, z: Floats, hold: Hold) -> pin.SE3:
        """Return the placement of a grasped object in the world at one configuration, (1, n)."""
        closure = self.chain.closures[hold]
        rotations, translations = self.chain.joint_placements(z)
        carrier = pin.SE3(rotations[0, closure.joint], translations[0, closure.joint])
        return carrier * closure.local

    def find_attached_geometries(self, phase: int) -> list[int]:
        """Return the geometries of grasped objects in a phase and of objects supported by them."""
        geometries = list[int]()
        for hold in self.task.phases[phase].held:
            geometries += self.chain.grasped_geometries[hold]
        for supported in self.task.phases[phase].supported:
            geometries += self.chain.supported_geometries[supported]
        return geometries

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
        q = self.chain.coordinates.q(z)
        phase_of = self.find_phases(waypoints)
        parts: list[tuple[NDArray[Any], ...]] = []
        for number in dict.fromkeys(phase_of.tolist()):
            members = np.flatnonzero(phase_of == number)
            queries = (q, z, waypoints)
            if len(members) < len(z):
                queries = (q[members], z[members], waypoints[members])
            found = self._clearances[number].find_closest_pairs(
                *queries, reach=reach, max_pairs=nearest, include_fixed=static
            )
            pairs = self.phases[number].pairs[found.pair]
            parts.append((members[found.row], pairs, *found[2:]))
        if len(parts) == 1:
            return Contacts(*parts[0])
        if not parts:
            return make_empty_contacts()
        contacts = Contacts(*[np.concatenate(column) for column in zip(*parts, strict=True)])
        by_waypoint = np.argsort(contacts.waypoint, kind="stable")
        return contacts.select(by_waypoint)

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
        rotations = []
        translations = []
        for row in range(0, max(len(z), 1), _KINEMATICS_BATCH):
            batch = self.chain.joint_placements(z[row : row + _KINEMATICS_BATCH])
            rotations.append(batch[0])
            translations.append(batch[1])
        return np.concatenate(rotations), np.concatenate(translations)

    def get_joints(self, geometries: Ints) -> Ints:
        """Return the chain's joints that carry `geometries`; 0 for geometry fixed in the world."""
        return self._joints[geometries]

    def compute_gradients(self, z: Floats, contacts: Contacts) -> Floats:
        """Return the distance gradients n·(∂b − ∂a) of contacts at `z`, shape (C, n)."""
        joints = self.get_joints(contacts.pair)
        which = np.tile(contacts.waypoint, 2)
        points = np.concatenate([contacts.first, contacts.second])
        jacobians = self.chain.point_jacobians(z, which, joints.T.ravel(), points)
        first, second = np.split(jacobians, 2)
        return np.asarray(np.einsum("ci,cij->cj", contacts.normal, second - first))

    def compute_normals(self, z: Floats, waypoints: Ints, pairs: Ints) -> Floats:
        """Return the normal, from first to second, of one pair per configuration, shape (B, 3)."""
        normals = np.empty((len(z), 3))
        phase_of = self.find_phases(waypoints)
        for number in set(phase_of.tolist()):
            members = np.flatnonzero(phase_of == number)
            clearances = self._clearances[number]
            q = self.chain.coordinates.q(z[members])
            where = clearances.placements.compute_placements(q)
            rows = np.arange(len(members))
            witnesses = clearances.shapes.compute_witnesses(where, rows, pairs[members])
            normals[members] = witnesses.normal
        return normals

    def compute_planes(self, z: Floats, contacts: Contacts, *, slots: int) -> tuple[Floats, Floats]:
        """Return the witness planes of the nearest contacts, C·vec(M(z)) − R ≥ 0.

        A plane states that its contact keeps the margin; M are the placements of all joints. Unused
        slots have C = 0, R = −1. With the witness point a at a' in the frame (R_i, t_i) of joint i,
        b at b' in that of joint j, and the margin m,

            n·(R_j b' + t_j) − n·(R_i a' + t_i) − m ≥ 0

        so that C has b'_k n for column k of R_j and n for t_j, and the negative of both for i. A
        point that is fixed in the world is part of R.

        Args:
            z: Configurations, shape (W, n).
            contacts: Contacts at these configurations.
            slots: Planes per configuration; further contacts are ignored.

        Returns:
            C, shape (W, slots, 12·joints), and R, shape (W, slots).
        """
        joints = self.chain.model.njoints - 1
        # for each joint the columns of its rotation, then its translation
        coefficients = np.zeros((len(z), slots, joints, 4, 3))
        offsets = np.full((len(z), slots), -1.0)
        rank = contacts.slot
        kept = np.flatnonzero(rank < slots)
        row = contacts.waypoint[kept]
        slot = rank[kept]
        normal = contacts.normal[kept]
        offset = contacts.margin[kept].copy()
        rotations, translations = self.chain.joint_placements(z)
        for column, witnesses, sign in ((0, contacts.first, -1.0), (1, contacts.second, 1.0)):
            points = witnesses[kept]
            joint = self._joints[contacts.pair[kept, column]]
            is_static = joint == 0
            offset[is_static] -= sign * np.einsum("ci,ci->c", normal[is_static], points[is_static])
            moves = ~is_static
            r = row[moves]
            s = slot[moves]
            j = joint[moves]
            n = normal[moves]
            # R_jᵀ (b − t_j)
            local = np.einsum("cij,ci->cj", rotations[r, j], points[moves] - translations[r, j])
            coefficients[r, s, j - 1, :3] += sign * local[:, :, None] * n[:, None, :]
            coefficients[r, s, j - 1, 3] += sign * n
        offsets[row, slot] = offset
        return coefficients.reshape(len(z), slots, 12 * joints), offsets
