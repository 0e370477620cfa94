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
        lower, upper = [], []
        followers = [int(index) for index in model.mimicking_joints]
        for index in range(1, model.njoints):
            joint = model.joints[index]
            name = model.names[index]
            i = joint.idx_q
            j = len(names)
            if joint.nv == 0 and index in followers:
                continue
            parts, limited, direct = _list_coordinates(joint, name)
            kind = joint.shortname()
            if kind == "JointModelPlanar":
                angles.append((i + 2, j + 2))
            elif kind == "JointModelFreeFlyer":
                quaternions.append((i + 3, j + 3))
            elif kind in _UNBOUNDED:
                angles.append((i, j))
            plain += [(i + k, j + k) for k in range(direct)]
            names += [name + part for part in parts]
            units += parts.values()
            lower += [
                *model.lowerPositionLimit[i : i + limited],
                *[-np.inf] * (len(parts) - limited),
            ]
            upper += [
                *model.upperPositionLimit[i : i + limited],
                *[np.inf] * (len(parts) - limited),
            ]
            joints += [index] * len(parts)
        self.names: tuple[str, ...] = tuple(names)
        self.units: tuple[str, ...] = tuple(units)
        self.joints: tuple[int, ...] = tuple(joints)
        self.size = len(names)
        self.lower: Floats = np.array(lower, float)
        self.upper: Floats = np.array(upper, float)
        self.velocity: Floats = np.array(model.velocityLimit, float)
        self.nq = int(model.nq)
        self.moves: tuple[MovedJoint, ...] = self._moves(model, followers)
        self.lengths, self.turns = np.zeros(self.size), np.zeros(self.size)
        for move in self.moves:
            (self.lengths if move.slides else self.turns)[move.coordinate] += abs(move.factor)
        self._joint_count = int(model.njoints)
        self._plain = plain
        self._angles = angles
        self._quaternions = quaternions
        self._runs = _merge_into_slices(plain)

    @property
    def followers(self) -> tuple[MovedJoint, ...]:
        """Entries of `moves` for mimic joints."""
        return tuple(move for move in self.moves if move.joint != self.joints[move.coordinate])

    def _moves(self, model: pin.Model, followers: list[int]) -> tuple[MovedJoint, ...]:
        """Return the joints driven by each coordinate."""
        moves = [
            MovedJoint(k, joint, 1.0, 0.0, self.units[k] == "m")
            for k, joint in enumerate(self.joints)
        ]
        if followers:
            data = model.createData()
            pin.forwardKinematics(model, data, pin.neutral(model))
            coordinate_of = {model.joints[joint].idx_q: k for k, joint in enumerate(self.joints)}
            # Pinocchio 4.1 may order `mimicked_joints` and `mimicking_joints` differently.
            for joint in followers:
                mimic_joint = model.joints[joint].extract()
                axis = np.asarray(data.joints[joint].S, float).ravel()
                factor, offset = float(mimic_joint.scaling), float(mimic_joint.offset)
                moves.append(
                    MovedJoint(
                        coordinate_of[model.joints[joint].idx_q],
                        joint,
                        factor,
                        offset,
                        not axis[3:].any(),
                    )
                )
        return tuple(sorted(moves))

    def find_moved_joints(self, changed: ArrayLike) -> Bools:
        """Return whether each joint of the model moves, shape (J,), including the universe.

        Args:
            changed: Whether each coordinate changes, shape (n,).
        """
        changed, found = np.asarray(changed, bool), np.zeros(self._joint_count, bool)
        found[[move.joint for move in self.moves if changed[move.coordinate]]] = True
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
            q[..., i], q[..., i + 1] = np.cos(angle), np.sin(angle)
        for i, j in self._quaternions:
            q[..., i : i + 4] = z[..., j : j + 4] / np.linalg.norm(
                z[..., j : j + 4], axis=-1, keepdims=True
            )
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
            z[..., j] = np.arctan2(q[..., i + 1].copy(), q[..., i].copy())
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
            entries[i], entries[i + 1] = casadi.cos(z[j]), casadi.sin(z[j])
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
        positions = {"_x": "m", "_y": "m", "_z": "m"}
        quaternion = {"_qx": "1", "_qy": "1", "_qz": "1", "_qw": "1"}
        return {**positions, **quaternion}, 0, 3
    if kind in _UNBOUNDED:
        return {"": "rad"}, 0, 0
    if joint.nq == 1 and joint.nv == 1:
        return {"": "m" if kind in _SLIDING else "rad"}, 1, 1
    expected = "a planar joint or one of 1 degree of freedom"
    raise InputError("this joint type is not supported", field=name, expected=expected, got=kind)


def wrap_angle(angle: Any) -> Any:
    """Return angles wrapped to [-π, π) [rad]."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _merge_into_slices(pairs: list[tuple[int, int]]) -> list[tuple[slice, slice]]:
    """Merge consecutive index pairs into pairs of slices, which index arrays much faster."""
    found: list[tuple[slice, slice]] = []
    for i, j in pairs:
        if found and (found[-1][0].stop, found[-1][1].stop) == (i, j):
            found[-1] = slice(found[-1][0].start, i + 1), slice(found[-1][1].start, j + 1)
        else:
            found.append((slice(i, i + 1), slice(j, j + 1)))
    return found
