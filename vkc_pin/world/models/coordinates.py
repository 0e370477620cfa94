"""Minimal coordinates z of a Pinocchio model: one number per degree of freedom.

Pinocchio stores a planar joint as (x, y, cos θ, sin θ) and a continuous joint as (cos θ, sin θ).
Users and the optimiser work with (x, y, θ) and θ; this module maps one to the other, for numbers
and for CasADi symbols.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import known, numbers
from vkc_pin.utils.arrays import Bools, Floats, Ints

__all__ = ["Coordinates", "MovedJoint", "wrap_angle"]

_SLIDING = ("JointModelPX", "JointModelPY", "JointModelPZ", "JointModelPrismaticUnaligned")
_UNBOUNDED = (
    "JointModelRUBX",
    "JointModelRUBY",
    "JointModelRUBZ",
    "JointModelRevoluteUnboundedUnaligned",
)


class MovedJoint(NamedTuple):
    """A joint that a coordinate moves: to factor · coordinate + offset, [m] or [rad].

    Attributes:
        coordinate: Its index.
        joint: The joint's.
        factor, offset: 1 and 0, but of a joint that follows another one.
        slides: Whether the coordinate slides it, rather than turns it.
    """

    coordinate: int
    joint: int
    factor: float
    offset: float
    slides: bool


class Coordinates:
    """The minimal coordinates of `model`.

    A joint that follows another one (`pinocchio.JointModelMimic`) has none: the other one's
    coordinate moves both.

    Attributes:
        names: One name per coordinate: the joint's, and for a planar joint `<joint>_x`,
            `<joint>_y`, `<joint>_yaw`; a free joint has seven, `<joint>_x`, `_y`, `_z` [m] and a
            quaternion `_qx`, `_qy`, `_qz`, `_qw` of any length but zero, so that it interpolates
            anywhere.
        units: For each coordinate "m" or "rad", and "1" for the parts of a quaternion.
        joints: For each coordinate, the index of the joint it belongs to.
        moves: What each coordinate moves: that joint first, then those that follow it; ordered by
            coordinate.
        lengths, turns: How far the joints that a coordinate moves go together, slide [m] and turn
            [rad] each, for a unit of it, shape (n,): 1 and 0, or 0 and 1, but of joints that others
            follow.
        size: Their number n (equal to `model.nv`, without free joints).
        lower, upper: Position limits, shape (n,), [m] or [rad]; infinite for continuous joints and
            the planar yaw.
        velocity: Velocity limits, shape (n,), [m/s] or [rad/s].

    Raises:
        InputError: The model has a joint that has no such coordinates (spherical, composite).
    """

    def __init__(self, model: pin.Model) -> None:
        names: list[str] = []
        units: list[str] = []
        joints: list[int] = []
        plain: list[tuple[int, int]] = []  # q[i] = z[j]
        angles: list[tuple[int, int]] = []  # q[i] = cos z[j], q[i + 1] = sin z[j]
        quaternions: list[tuple[int, int]] = []  # q[i:i + 4] = z[j:j + 4], made a unit
        lower, upper = [], []
        followers = [int(index) for index in model.mimicking_joints]
        for index in range(1, model.njoints):
            joint, name, i, j = (
                model.joints[index],
                model.names[index],
                model.joints[index].idx_q,
                len(names),
            )
            if joint.nv == 0 and index in followers:
                continue
            kind, limited, straight = (
                joint.shortname(),
                0,
                0,
            )  # coordinates with limits, and those that are Pinocchio's own
            if kind == "JointModelPlanar":
                parts, limited, straight = {"_x": "m", "_y": "m", "_yaw": "rad"}, 2, 2
                angles.append((i + 2, j + 2))
            elif kind == "JointModelFreeFlyer":
                parts, straight = (
                    {
                        "_x": "m",
                        "_y": "m",
                        "_z": "m",
                        "_qx": "1",
                        "_qy": "1",
                        "_qz": "1",
                        "_qw": "1",
                    },
                    3,
                )
                quaternions.append((i + 3, j + 3))
            elif kind in _UNBOUNDED:
                parts = {"": "rad"}
                angles.append((i, j))
            elif joint.nq == 1 and joint.nv == 1:
                parts, limited, straight = {"": "m" if kind in _SLIDING else "rad"}, 1, 1
            else:
                expected = "a planar joint or one of 1 degree of freedom"
                raise InputError(
                    "this joint type is not supported", field=name, expected=expected, got=kind
                )
            plain += [(i + k, j + k) for k in range(straight)]
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
        self._plain, self._angles, self._quaternions, self._runs = (
            plain,
            angles,
            quaternions,
            _merge_into_slices(plain),
        )

    @property
    def index_maps(self) -> tuple[Ints, Ints, Ints]:
        """Where in q, and where in z, what `q` maps begins, shape (K, 2) each: equal numbers, angles, quaternions."""
        plain, angles, quaternions = (
            np.array(p, int).reshape(-1, 2) for p in (self._plain, self._angles, self._quaternions)
        )
        return plain, angles, quaternions

    @property
    def followers(self) -> tuple[MovedJoint, ...]:
        """Those of `moves` whose joint follows another one."""
        return tuple(move for move in self.moves if move.joint != self.joints[move.coordinate])

    def _moves(self, model: pin.Model, followers: list[int]) -> tuple[MovedJoint, ...]:
        """Return `moves`."""
        moves = [
            MovedJoint(k, joint, 1.0, 0.0, self.units[k] == "m")
            for k, joint in enumerate(self.joints)
        ]
        if followers:
            data = model.createData()
            pin.forwardKinematics(model, data, pin.neutral(model))
            at = {model.joints[joint].idx_q: k for k, joint in enumerate(self.joints)}
            # `mimicked_joints` of Pinocchio 4.1 are not always in the order of `mimicking_joints`
            for joint in followers:
                following, axis = (
                    model.joints[joint].extract(),
                    np.asarray(data.joints[joint].S, float).ravel(),
                )
                factor, offset = float(following.scaling), float(following.offset)
                moves.append(
                    MovedJoint(
                        at[model.joints[joint].idx_q], joint, factor, offset, not axis[3:].any()
                    )
                )
        return tuple(sorted(moves))

    def find_moved_joints(self, changed: ArrayLike) -> Bools:
        """Return which joints of the model some coordinates move, shape (J,), the universe among them.

        Args:
            changed: Which coordinates change, shape (n,).
        """
        changed, found = np.asarray(changed, bool), np.zeros(self._joint_count, bool)
        found[[move.joint for move in self.moves if changed[move.coordinate]]] = True
        return found

    def compute_max_steps(self, length: float, angle: float) -> Floats:
        """Return how far each coordinate can go so that no joint goes further than that, shape (n,) [m] or [rad].

        Args:
            length: How far joints may slide [m].
            angle: How far they may turn [rad].
        """
        found = np.full(self.size, np.inf)
        for move in self.moves:
            stride = (length if move.slides else angle) / abs(move.factor)
            found[move.coordinate] = min(found[move.coordinate], stride)
        return found

    def q(self, z: ArrayLike) -> Floats:
        """Return Pinocchio's configuration(s), shape (..., nq), of minimal coordinates `z`, shape (..., n)."""
        z = numbers(z, "z")
        if z.shape[-1:] != (self.size,):
            raise InputError(
                "wrong number of coordinates",
                field="z",
                expected=f"(..., {self.size})",
                got=z.shape,
            )
        q = np.empty((*z.shape[:-1], self.nq))
        for there, here in self._runs:
            q[..., there] = z[..., here]
        for i, j in self._angles:
            angle = z[..., j].copy()  # without gaps, where NumPy may compute otherwise
            q[..., i], q[..., i + 1] = np.cos(angle), np.sin(angle)
        for i, j in self._quaternions:
            q[..., i : i + 4] = z[..., j : j + 4] / np.linalg.norm(
                z[..., j : j + 4], axis=-1, keepdims=True
            )
        return q

    def z(self, q: ArrayLike) -> Floats:
        """Return the minimal coordinates, shape (..., n), of `q`, shape (..., nq); angles in (-π, π]."""
        q = numbers(q, "q")
        if q.shape[-1:] != (self.nq,):
            raise InputError(
                "wrong size of configuration", field="q", expected=f"(..., {self.nq})", got=q.shape
            )
        z = np.empty((*q.shape[:-1], self.size))
        for there, here in self._runs:
            z[..., here] = q[..., there]
        for i, j in self._angles:
            z[..., j] = np.arctan2(q[..., i + 1].copy(), q[..., i].copy())
        for i, j in self._quaternions:
            z[..., j : j + 4] = q[..., i : i + 4]
        return z

    def q_symbolic(self, z: Any) -> Any:
        """Return Pinocchio's configuration of the CasADi column `z` (SX or MX), shape (nq, 1); free joints have none."""
        import casadi

        entries: list[Any] = [None] * self.nq
        for i, j in self._plain:
            entries[i] = z[j]
        for i, j in self._angles:
            entries[i], entries[i + 1] = casadi.cos(z[j]), casadi.sin(z[j])
        return casadi.vertcat(*entries)

    def index(self, name: str) -> int:
        """Return the position of coordinate `name` in z. Raises `UnknownNameError` if there is none."""
        return self.names.index(known(name, self.names, "coordinate"))


def wrap_angle(angle: Any) -> Any:
    """Return an angle, or an array of them, between -π and π [rad]."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _merge_into_slices(pairs: list[tuple[int, int]]) -> list[tuple[slice, slice]]:
    """Return pairs that follow each other as slices, which arrays are indexed with in a fraction of the time."""
    found: list[tuple[slice, slice]] = []
    for i, j in pairs:
        if found and (found[-1][0].stop, found[-1][1].stop) == (i, j):
            found[-1] = slice(found[-1][0].start, i + 1), slice(found[-1][1].start, j + 1)
        else:
            found.append((slice(i, i + 1), slice(j, j + 1)))
    return found
