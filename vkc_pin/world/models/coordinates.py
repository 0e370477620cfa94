"""Maps minimal coordinates z of a Pinocchio model, one per degree of freedom, to its q.

Pinocchio stores a planar joint as (x, y, cos θ, sin θ) and a continuous joint as (cos θ, sin θ).
Users and the optimizer work with (x, y, θ) and θ. This module converts numbers and CasADi symbols.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import check_array, check_choice
from vkc_pin.utils.arrays import Bools, Floats

_SLIDING = ("JointModelPX", "JointModelPY", "JointModelPZ", "JointModelPrismaticUnaligned")
_UNBOUNDED = (
    "JointModelRUBX",
    "JointModelRUBY",
    "JointModelRUBZ",
    "JointModelRevoluteUnboundedUnaligned",
)


class MovedJoint(NamedTuple):
    """A joint driven by a coordinate: its position is factor · coordinate + offset, [m] or [rad].

    Attributes:
        coordinate: Index of the coordinate.
        joint: Index of the joint.
        factor, offset: 1 and 0, except for mimic joints.
        slides: Whether the joint is prismatic.
    """

    coordinate: int
    joint: int
    factor: float
    offset: float
    slides: bool


class Coordinates:
    """Minimal coordinates of `model`.

    Mimic joints (`pinocchio.JointModelMimic`) share the coordinate of their leader.

    Attributes:
        names: Name of each coordinate: that of the joint; `<joint>_x`, `<joint>_y`, `<joint>_yaw`
            for a planar joint; `<joint>_x`, `_y`, `_z` [m] and `_qx`, `_qy`, `_qz`, `_qw` for a
            free joint. Its quaternion may have any length but zero, so that it can be
            interpolated.
        units: Unit of each coordinate: "m", "rad", or "1" for components of a quaternion.
        joints: Index of the joint that each coordinate belongs to.
        moves: Joints driven by each coordinate, its own joint before the mimic joints; sorted by
            coordinate.
        lengths, turns: Total translation [m] and rotation [rad] of the joints that a coordinate
            drives, per unit of the coordinate, shape (n,). 1 and 0, or 0 and 1, unless there are
            mimic joints.
        size: Number of coordinates n (equal to `model.nv` without free joints).
        lower, upper: Position limits, shape (n,), [m] or [rad]; infinite for continuous joints and
            the planar yaw.
        velocity: Velocity limits, shape (n,), [m/s] or [rad/s].
    """

    def __init__(self, model: pin.Model) -> None:
        names: list[str] = []
        units: list[str] = []
        joints: list[int] = []
        plain: list[tuple[int, int]] = []  # q[i] = z[j]
        angles: list[tuple[int, int]] = []  # q[i] = cos z[j], q[i + 1] = sin z[j]
        quaternions: list[tuple[int, int]] = []  # q[i:i + 4] = z[j:j + 4], normalized
        lower: list[float] = []
        upper: list[float] = []
        followers = [int(index) for index in model.mimicking_joints]
        for index in range(1, model.njoints):
            joint = model.joints[index]
            if joint.nv == 0 and index in followers:
                continue
            name = model.names[index]
            kind = joint.shortname()
            parts, limited, direct = _list_coordinates(joint, name)
            i = joint.idx_q
            j = len(names)
            if kind == "JointModelPlanar":
                angles.append((i + 2, j + 2))
            elif kind == "JointModelFreeFlyer":
                quaternions.append((i + 3, j + 3))
            elif kind in _UNBOUNDED:
                angles.append((i, j))
            plain += [(i + k, j + k) for k in range(direct)]
            names += [name + part for part in parts]
            units += parts.values()
            joints += [index] * len(parts)
            unlimited = len(parts) - limited
            lower += [*model.lowerPositionLimit[i : i + limited]]
            lower += [-np.inf] * unlimited
            upper += [*model.upperPositionLimit[i : i + limited]]
            upper += [np.inf] * unlimited
        self.names: tuple[str, ...] = tuple(names)
        self.units: tuple[str, ...] = tuple(units)
        self.joints: tuple[int, ...] = tuple(joints)
        self.size = len(names)
        self.lower: Floats = np.array(lower, float)
        self.upper: Floats = np.array(upper, float)
        self.velocity: Floats = np.array(model.velocityLimit, float)
        self.nq = int(model.nq)
        self.moves: tuple[MovedJoint, ...] = self._find_moves(model, followers)
        self.lengths = np.zeros(self.size)
        self.turns = np.zeros(self.size)
        for move in self.moves:
            totals = self.lengths if move.slides else self.turns
            totals[move.coordinate] += abs(move.factor)
        self._joint_count = int(model.njoints)
        self._plain = plain
        self._angles = angles
        self._quaternions = quaternions
        self._runs = _merge_into_slices(plain)

    @property
    def followers(self) -> tuple[MovedJoint, ...]:
        """Entries of `moves` for mimic joints."""
        return tuple(move for move in self.moves if move.joint != self.joints[move.coordinate])

    def _find_moves(self, model: pin.Model, followers: list[int]) -> tuple[MovedJoint, ...]:
        """Return the joints driven by each coordinate, sorted by coordinate."""
        moves = list[MovedJoint]()
        coordinate_of = dict[int, int]()  # index in q → coordinate
        for coordinate, joint in enumerate(self.joints):
            slides = self.units[coordinate] == "m"
            moves.append(MovedJoint(coordinate, joint, 1.0, 0.0, slides))
            coordinate_of[model.joints[joint].idx_q] = coordinate
        if followers:
            data = model.createData()
            pin.forwardKinematics(model, data, pin.neutral(model))
        # A mimic joint has the index in q of its leader, which is asked here because Pinocchio 4.1
        # may order `mimicked_joints` and `mimicking_joints` differently.
        for joint in followers:
            coordinate = coordinate_of[model.joints[joint].idx_q]
            mimic_joint = model.joints[joint].extract()
            factor = float(mimic_joint.scaling)
            offset = float(mimic_joint.offset)
            # The motion subspace S has the linear velocity, then the angular one.
            subspace = np.asarray(data.joints[joint].S, float).ravel()
            slides = not subspace[3:].any()
            moves.append(MovedJoint(coordinate, joint, factor, offset, slides))
        return tuple(sorted(moves))

    def find_moved_joints(self, changed: ArrayLike) -> Bools:
        """Return whether each joint of the model moves, shape (J,), including the universe.

        Args:
            changed: Whether each coordinate changes, shape (n,).
        """
        changed = np.asarray(changed, bool)
        found = np.zeros(self._joint_count, bool)
        moved = [move.joint for move in self.moves if changed[move.coordinate]]
        found[moved] = True
        return found

    def compute_max_steps(self, length: float, angle: float) -> Floats:
        """Return the largest steps of the coordinates that respect joint steps, shape (n,).

        Args:
            length: Largest step of prismatic joints [m].
            angle: Largest step of revolute joints [rad].

        Returns:
            Steps [m] or [rad].
        """
        found = np.full(self.size, np.inf)
        for move in self.moves:
            step = (length if move.slides else angle) / abs(move.factor)
            found[move.coordinate] = min(found[move.coordinate], step)
        return found

    def q(self, z: ArrayLike) -> Floats:
        """Return Pinocchio's configurations q, shape (..., nq), for `z`, shape (..., n)."""
        z = check_array(z, "z")
        if z.shape[-1:] != (self.size,):
            raise InputError(
                "wrong number of coordinates",
                field="z",
                expected=f"(..., {self.size})",
                got=z.shape,
            )
        q = np.empty((*z.shape[:-1], self.nq))
        for q_slice, z_slice in self._runs:
            q[..., q_slice] = z[..., z_slice]
        for i, j in self._angles:
            angle = z[..., j].copy()  # contiguous, since NumPy may round differently otherwise
            q[..., i] = np.cos(angle)
            q[..., i + 1] = np.sin(angle)
        for i, j in self._quaternions:
            quaternion = z[..., j : j + 4]
            norm = np.linalg.norm(quaternion, axis=-1, keepdims=True)
            q[..., i : i + 4] = quaternion / norm
        return q

    def z(self, q: ArrayLike) -> Floats:
        """Return minimal coordinates, shape (..., n), for `q`, shape (..., nq).

        Angles are in (-π, π].
        """
        q = check_array(q, "q")
        if q.shape[-1:] != (self.nq,):
            raise InputError(
                "wrong size of configuration", field="q", expected=f"(..., {self.nq})", got=q.shape
            )
        z = np.empty((*q.shape[:-1], self.size))
        for q_slice, z_slice in self._runs:
            z[..., z_slice] = q[..., q_slice]
        for i, j in self._angles:
            cosine = q[..., i].copy()
            sine = q[..., i + 1].copy()
            z[..., j] = np.arctan2(sine, cosine)
        for i, j in self._quaternions:
            z[..., j : j + 4] = q[..., i : i + 4]
        return z

    def q_symbolic(self, z: Any) -> Any:
        """Return Pinocchio's q for a CasADi column `z` (SX or MX), shape (nq, 1).

        Free joints are not supported.
        """
        import casadi

        entries: list[Any] = [None] * self.nq
        for i, j in self._plain:
            entries[i] = z[j]
        for i, j in self._angles:
            entries[i] = casadi.cos(z[j])
            entries[i + 1] = casadi.sin(z[j])
        return casadi.vertcat(*entries)

    def index(self, name: str) -> int:
        """Return the index of coordinate `name` in z."""
        return self.names.index(check_choice(name, self.names, "coordinate"))


def _list_coordinates(joint: pin.JointModel, name: str) -> tuple[dict[str, str], int, int]:
    """Return the coordinates of a joint.

    Returns:
        Suffix of the name → unit of each coordinate, how many of the first have position limits,
        and how many of the first are entries of q themselves.

    Raises:
        InputError: There are no coordinates for joints of this type.
    """
    kind = joint.shortname()
    if kind == "JointModelPlanar":
        return {"_x": "m", "_y": "m", "_yaw": "rad"}, 2, 2
    if kind == "JointModelFreeFlyer":
        units = {"_x": "m", "_y": "m", "_z": "m", "_qx": "1", "_qy": "1", "_qz": "1", "_qw": "1"}
        return units, 0, 3
    if kind in _UNBOUNDED:
        return {"": "rad"}, 0, 0
    if joint.nq == 1 and joint.nv == 1:
        unit = "m" if kind in _SLIDING else "rad"
        return {"": unit}, 1, 1
    expected = "a planar joint or one of 1 degree of freedom"
    raise InputError("this joint type is not supported", field=name, expected=expected, got=kind)


def wrap_angle(angle: Any) -> Any:
    """Return angles wrapped to [-π, π) [rad]."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _merge_into_slices(pairs: list[tuple[int, int]]) -> list[tuple[slice, slice]]:
    """Merge consecutive index pairs into pairs of slices, which index arrays much faster."""
    found: list[tuple[slice, slice]] = []
    for i, j in pairs:
        first_i = i
        first_j = j
        if found:
            before_i, before_j = found[-1]
            if before_i.stop == i and before_j.stop == j:
                found.pop()
                first_i = before_i.start
                first_j = before_j.start
        found.append((slice(first_i, i + 1), slice(first_j, j + 1)))
    return found
