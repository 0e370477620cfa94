"""Signed distances of collision pairs (coal) and witness planes: the clearances of eqs. 6 and 7, linearised.

For a pair (A, B) coal gives the witness points a, b and the normal n of the signed distance d =
n·(b − a). With a fixed in A's body, b in B's and n in the world, n·(b(z) − a(z)) is smooth in z,
and its value and gradient equal the signed distance's at the linearisation point. It is linear in
the placements of the joints, C·vec(M(z)) − R.
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
from vkc_pin.planning.chain.collision_pairs import phase_geometries
from vkc_pin.planning.chain.phase_geometry import PhaseGeometry
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.utils.budget import spend
from vkc_pin.world.collision.clearances import Clearances
from vkc_pin.world.collision.placements import ShapePlacements
from vkc_pin.world.collision.shapes import Shapes
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.phases import Task

__all__ = ["ContactModel", "Contacts", "make_empty_contacts"]

# of coal's distances: at its own 1e-6 the gradients of planes are off by up to 5e-3; this takes no
# longer
_TOLERANCE = 1e-8
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

    waypoint: Ints
    pair: Ints
    distance: Floats
    margin: Floats
    normal: Floats
    first: Floats
    second: Floats

    def arrays(self) -> tuple[NDArray[Any], ...]:
        """Return its arrays in the order of the attributes."""
        return (
            self.waypoint,
            self.pair,
            self.distance,
            self.margin,
            self.normal,
            self.first,
            self.second,
        )

    def select(self, index: Ints) -> Contacts:
        """Return the contacts at `index`, in that order."""
        return Contacts(*(array[index] for array in self.arrays()))

    @property
    def place(self) -> Ints:
        """The place of each contact among those of its waypoint, from 0, shape (C,)."""
        return np.arange(len(self.waypoint)) - np.searchsorted(self.waypoint, self.waypoint)

    def violation(self) -> float:
        """Return by how much the worst pair falls short of its margin [m]; 0 if none does."""
        return float(max(0.0, np.max(self.margin - self.distance, initial=0.0)))

    def shortfall(self, segments: int) -> Floats:
        """Return by how much the worst pair of each of `segments` configurations falls short [m], shape (segments,)."""
        worst = np.zeros(segments)
        np.maximum.at(worst, self.waypoint, self.margin - self.distance)
        return worst

    def clearance(self) -> float:
        """Return the smallest distance [m]; infinite if nothing is close."""
        return float(np.min(self.distance, initial=np.inf))


def make_empty_contacts() -> Contacts:
    """Return contacts of nothing with nothing."""
    none, vectors = np.zeros(0), np.zeros((0, 3))
    return Contacts(np.zeros(0, int), np.zeros((0, 2), int), none, none, vectors, vectors, vectors)


class ContactModel:
    """What can collide with what in each phase of a task, and how close it is.

    Attributes:
        phases: Geometry and pairs per phase.
        first_waypoint: Waypoint at which each phase starts.
    """

    def __init__(
        self, scene: Scene, chain: VirtualKinematicChain, task: Task, options: Options
    ) -> None:
        self.scene, self.chain, self.task = scene, chain, task
        self.first_waypoint = np.concatenate(
            [[0], np.cumsum([phase.segments for phase in task.phases])]
        )
        openings = dict.fromkeys(phase.opening for phase in task.phases)
        placed = {
            opening: ShapePlacements(chain.model, chain.opened(opening)) for opening in openings
        }
        self.phases = phase_geometries(scene, chain, task, options)
        self._clearances = [
            self._clearances_of(part, placed[phase.opening])
            for part, phase in zip(self.phases, task.phases, strict=True)
        ]
        # Beyond the chain's own geometries everything stands in the world.
        own = [shape.parentJoint for shape in chain.collision.geometryObjects]
        self._joints = np.array(
            own + [0] * (max(len(part.labels) for part in self.phases) - len(own))
        )

    def _clearances_of(self, part: PhaseGeometry, placed: ShapePlacements) -> Clearances:
        moving = len(self.chain.collision.geometryObjects)
        standing = [shape.placement for shape in part.shapes[moving:]]
        shapes = Shapes([shape.geometry for shape in part.shapes], standing, tolerance=_TOLERANCE)
        return Clearances(placed, part.boxes, shapes, part.margin_table)

    def settled(self, z: Floats) -> ContactModel:
        """Return the same, where what the motion z_1..z_N, shape (N, n), leaves behind stands where that motion leaves it.

        Before, it stands where the task says, which is only nearly there where the motion chooses
        the place itself.
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
                shapes = zip(self.phases[number].left[name], make_world_shapes(placed), strict=True)
                where |= {index: shape.placement for index, shape in shapes}
            if where:
                view.phases[number] = self.phases[number].placed(where)
                view._clearances[number] = self._clearances[number].placed(
                    view.phases[number].boxes, where
                )
        return view

    def carried(self, phase: int) -> list[int]:
        """Return the geometries of what is held in a phase, and of what rides on that."""
        held, riding = self.task.phases[phase].held, self.task.phases[phase].supported
        found = [self.chain.held_geometries[hold] for hold in held] + [
            self.chain.ride_geometries[ride] for ride in riding
        ]
        return [i for indices in found for i in indices]

    def phase_of(self, waypoint: int) -> int:
        """Return the phase whose geometry holds at `waypoint`: at a boundary the earlier, before the grasp."""
        return max(int(self.first_waypoint.searchsorted(waypoint)) - 1, 0)

    def phases_of(self, waypoints: Ints) -> Ints:
        """Return the phase of each waypoint, shape (W,), see `phase_of`."""
        return np.maximum(np.searchsorted(self.first_waypoint, waypoints) - 1, 0)

    def inside(self, phase: int) -> int:
        """Return a waypoint at which a phase's geometry holds."""
        return int(self.first_waypoint[phase]) + 1

    def evaluate(
        self,
        z: Floats,
        waypoints: Ints,
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
            nearest: How many of them to return per configuration, those that fall shortest of their
                margins; None: all.
            standing: Whether what stands in the world counts, too; otherwise only pairs of which
                both move.
        """
        spend(len(z))
        q, phase_of = self.chain.coordinates.q(z), self.phases_of(waypoints)
        parts: list[tuple[NDArray[Any], ...]] = []
        for number in dict.fromkeys(phase_of.tolist()):
            inside = np.flatnonzero(phase_of == number)
            asked = (
                (q, z, waypoints)
                if len(inside) == len(z)
                else (q[inside], z[inside], waypoints[inside])
            )
            found = self._clearances[number].nearest(
                *asked, reach=reach, most=nearest, standing=standing
            )
            pairs = self.phases[number].pairs[found.pair]
            parts.append((inside[found.row], pairs, *found[2:]))
        if len(parts) == 1:
            return Contacts(*parts[0])
        if not parts:
            return make_empty_contacts()
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        return Contacts(*columns).select(np.argsort(columns[0], kind="stable"))

    def first_blocked(self, z: Floats, waypoint: int, *, reach: float, allowed: float) -> int:
        """Return the first configuration in which a pair falls short of its margin by more than `allowed` [m]; W: none.

        Nothing is looked at beyond that pair. That saves most of what `evaluate` does where all
        that counts is what is hit first.

        Args:
            z: Configurations, shape (W, n).
            waypoint: To whose phase all of them belong.
            reach: Pairs further apart do not count [m].
            allowed: [m].
        """
        clearances = self._clearances[self.phase_of(waypoint)]
        found = clearances.first_blocked(
            self.chain.coordinates.q(z), z, waypoint, reach=reach, allowed=allowed
        )
        spend(min(found + 1, len(z)))
        return found

    def lines(
        self,
        z: Floats,
        waypoint: int,
        *,
        weights: Floats,
        step: float,
        reach: float,
        allowed: float,
    ) -> Any:
        """Return what looks at straight lines of the first coordinates, with all else as in z; see `Clearances.lines`.

        Args:
            z: A configuration, shape (n,).
            waypoint: Whose phase it is.
            weights: How much each coordinate that moves counts, shape (m,).
            step: How far it goes at most, times its weight, from one configuration that is looked
                at to the next.
            reach: Pairs further apart do not count [m].
            allowed: [m].
        """
        places, clearances = (
            self.chain.coordinates.places,
            self._clearances[self.phase_of(waypoint)],
        )
        return clearances.lines(
            places, z, waypoint, weights=weights, step=step, reach=reach, allowed=allowed
        )

    def placements(self, z: Floats) -> tuple[Floats, Floats]:
        """Return the same as the chain's `joint_placements`; in portions of one size, as CasADi prepares for each size anew."""
        parts = [
            self.chain.joint_placements(z[row : row + _ROWS])
            for row in range(0, max(len(z), 1), _ROWS)
        ]
        return np.concatenate([rotations for rotations, _ in parts]), np.concatenate(
            [moves for _, moves in parts]
        )

    def joints_of(self, geometries: Ints) -> Ints:
        """Return the joints of the chain that carry `geometries`; 0 for what stands in the world."""
        return self._joints[geometries]

    def gradients(self, z: Floats, contacts: Contacts) -> Floats:
        """Return the gradients of the distances of contacts at configurations `z`, shape (B, n): n·(∂b − ∂a), shape (C, n)."""
        joints = self.joints_of(contacts.pair)
        which, points = (
            np.tile(contacts.waypoint, 2),
            np.concatenate([contacts.first, contacts.second]),
        )
        first, second = np.split(self.chain.point_jacobians(z, which, joints.T.ravel(), points), 2)
        return np.asarray(np.einsum("ci,cij->cj", contacts.normal, second - first))

    def normals(self, z: Floats, waypoints: Ints, pairs: Ints) -> Floats:
        """Return the normals from first to second of pairs, shape (B, 2), each at its configuration: shape (B, 3).

        Args:
            z: Configurations, shape (B, n).
            waypoints: For each, the waypoint whose phase it belongs to, shape (B,).
            pairs: Geometries of these phases.
        """
        found, phase_of = np.empty((len(z), 3)), self.phases_of(waypoints)
        for number in set(phase_of.tolist()):
            inside = np.flatnonzero(phase_of == number)
            where = self._clearances[number].placements.at(self.chain.coordinates.q(z[inside]))
            found[inside] = (
                self._clearances[number]
                .shapes.witnesses(where, np.arange(len(inside)), pairs[inside])
                .normal
            )
        return found

    def planes(self, z: Floats, contacts: Contacts, *, slots: int) -> tuple[Floats, Floats]:
        """Return the coefficients C, shape (W, slots, 12·joints), and offsets R, shape (W, slots), of the nearest contacts.

        C·vec(M(z)) − R ≥ 0 says that a contact keeps its margin; M are the placements of all joints
        (see `cpin`). Slots that nothing needs have C = 0, R = −1.

        Args:
            z: Configurations, shape (W, n).
            contacts: What is close there.
            slots: How many planes a configuration has; contacts beyond these are left out.
        """
        joints = self.chain.model.njoints - 1
        coefficients = np.zeros((len(z), slots, joints, 4, 3))  # per joint the columns of R, then t
        offsets = np.full((len(z), slots), -1.0)
        place = contacts.place
        keep = np.flatnonzero(place < slots)
        row, slot, normal = contacts.waypoint[keep], place[keep], contacts.normal[keep]
        offset = contacts.margin[keep].copy()
        rotations, translations = self.chain.joint_placements(z)
        for column, points, sign in (
            (0, contacts.first[keep], -1.0),
            (1, contacts.second[keep], 1.0),
        ):
            joint = self._joints[contacts.pair[keep, column]]
            still = joint == 0
            offset[still] -= sign * np.einsum("ci,ci->c", normal[still], points[still])
            r, s, j, n = row[~still], slot[~still], joint[~still], normal[~still]
            local = np.einsum("cij,ci->cj", rotations[r, j], points[~still] - translations[r, j])
            coefficients[r, s, j - 1, :3] += sign * local[:, :, None] * n[:, None, :]
            coefficients[r, s, j - 1, 3] += sign * n
        offsets[row, slot] = offset
        return coefficients.reshape(len(z), slots, 12 * joints), offsets
