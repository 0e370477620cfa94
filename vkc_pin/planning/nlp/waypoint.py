"""The constraint rows of one waypoint (eqs. 2, 3, 6 and 7), and of one step of a base on wheels.

They are SX functions, small, exact to second order, mapped over waypoints or steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin

from vkc_pin.planning.chain.kinematics import kinematics_of
from vkc_pin.planning.chain.pose import AWAY, PoseRow, pose_rows, receded
from vkc_pin.planning.kinematics.batch import size_of
from vkc_pin.planning.kinematics.machine_code import MachineCode
from vkc_pin.planning.nlp.sparse import assemble
from vkc_pin.planning.nlp.term_rows import TermRow
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.utils.budget import spend
from vkc_pin.utils.cache import Cache
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.trajectory.wheels import ANYWHERE, Rolling

__all__ = ["StepRows", "Structure", "WaypointFunctions", "waypoint_functions"]

# waypoints of one kind from which on it is compiled: most kinds have one, at a grasp, or some
# thirty
_WORTH = 4


@dataclass(frozen=True, eq=False, kw_only=True)
class Structure:
    """What a symbolic program depends on.

    Attributes:
        model: The chain.
        segments: N, the number of waypoints after the start.
        poses: Frames that must be somewhere.
        slots: K, witness planes per waypoint.
        stops: Waypoints inside the motion at which it comes to rest, as it does at start and end.
        rolling: How the base may move.
        clamped: (column, first, last): coordinates that keep their value from waypoint `first` to
            `last`, as a hand does that clamps.
        pushed: (column, first, last, way): coordinates that only go up (way 1) or down (-1) from
            waypoint `first` to `last`.
        terms: The user's own constraints and costs.
    """

    model: pin.Model
    segments: int
    poses: tuple[PoseRow, ...]
    slots: int
    stops: tuple[int, ...] = ()
    rolling: Rolling = ANYWHERE
    clamped: tuple[tuple[int, int, int], ...] = ()
    pushed: tuple[tuple[int, int, int, int], ...] = ()
    terms: tuple[TermRow, ...] = ()

    @property
    def timed(self) -> bool:
        """Whether the time of a step counts."""
        return any(term.formula.timed for term in self.terms)

    @cached_property
    def key(self) -> tuple[Any, ...]:
        """Equal for structures that share one program."""
        poses = tuple((*_key(pose), pose.waypoints) for pose in self.poses)
        others = (self.stops, self.rolling, self.clamped, self.pushed, self.terms)
        return (self.model.saveToString(), self.segments, poses, self.slots, *others)


def _key(pose: PoseRow) -> tuple[Any, ...]:
    """Equal for poses that are asked for with the same rows."""
    return pose.joint, (pose.local.homogeneous + 0.0).tobytes(), pose.kind, pose.shift


def waypoint_functions(
    model: pin.Model, slots: int, poses: tuple[PoseRow, ...], cache: Cache
) -> WaypointFunctions:
    """Return the functions of one kind of waypoint, built if they are not in the cache."""
    key = ("waypoint", model.saveToString(), slots, *(_key(pose) for pose in poses))
    return cache.get(key, lambda: WaypointFunctions(model, slots, poses, cache))


class WaypointFunctions:
    """The SX functions of one kind of waypoint: a model, so many witness planes, and which poses it must satisfy."""

    def __init__(
        self, model: pin.Model, slots: int, poses: tuple[PoseRow, ...], cache: Cache
    ) -> None:
        n, joints = Coordinates(model).size, model.njoints - 1
        z, s, share = ca.SX.sym("z", n), ca.SX.sym("s", slots), ca.SX.sym("e")
        planes, offsets = ca.SX.sym("C", slots, 12 * joints), ca.SX.sym("R", slots)
        targets, away = (
            ca.SX.sym("W", 12, max(len(poses), 1)),
            ca.SX.sym("D", AWAY, max(len(poses), 1)),
        )
        sweep = cache.get(
            ("sweep", model.saveToString(), slots), lambda: _Sweep(model, slots, cache)
        )
        placements, slopes_of_planes = sweep.function(z, planes)
        stacked = ca.vec(placements)
        # Every row is linear in the placements: rows = L·vec(M) + const, so one sweep of the
        # kinematics serves them all.
        parts = []
        for k, pose in enumerate(poses):
            target = receded(targets[:, k], away[:, k], share)
            parts.append(pose_rows(pose.kind, *pose.placement(placements), target))
        pose_values = ca.vertcat(*parts) if parts else ca.SX(0, 1)
        self.pose_rows = [pose.rows for pose in poses]
        self.rows = slots + sum(self.pose_rows)
        rows = ca.vertcat(planes @ stacked - offsets + s, pose_values)
        multipliers = ca.SX.sym("lam", self.rows)
        of_planes, of_poses = ca.vertsplit(
            multipliers, [0, slots, self.rows]
        )  # a slice of a scalar would be a row
        own = ca.vertcat(z, s, share)
        slopes = ca.horzcat(slopes_of_planes, ca.SX.eye(slots), ca.SX(slots, 1))
        jacobian = ca.vertcat(slopes, ca.jacobian(pose_values, own))
        spend()
        w = ca.SX.sym("w", 12 * joints)
        hessian = ca.triu(ca.hessian(ca.dot(w, stacked) + ca.dot(of_poses, pose_values), own)[0])
        inner = ca.Function("inner", [z, share, targets, away, w, multipliers], [hessian])
        hessian = inner(z, share, targets, away, planes.T @ of_planes, multipliers)
        inputs = [own, ca.vec(planes), offsets, ca.vec(targets), ca.vec(away)]
        spend()
        self.value = ca.Function("g", inputs, [rows])
        self.jacobian = ca.Function("rows_jacobian", inputs, [ca.vertcat(*jacobian.nonzeros())])
        spend()
        self.jacobian_pattern = jacobian.sparsity().get_triplet()
        self.hessian = ca.Function(
            "lagrangian_hessian", [*inputs, multipliers], [ca.vertcat(*hessian.nonzeros())]
        )
        self.hessian_pattern = hessian.sparsity().get_triplet()
        self.code = MachineCode(self.value, self.jacobian, self.hessian)
        self.nbytes = size_of(self.value, self.jacobian, self.hessian)

    def hasten(self, waypoints: int) -> list[MachineCode]:
        """Become machine code if there is some and so many waypoints are worth it; return what is worth waiting for."""
        if waypoints < _WORTH:
            return []
        self.code.look()
        self.value, self.jacobian, self.hessian = self.code.functions
        return [] if self.code.compiled else [self.code]


class StepRows:
    """The rows of all steps of a base on wheels, from one pose (x, y, yaw) to the next, in gears, 1 ahead or -1 back.

    Those of a step, all in metres, with c along, s aside and δθ turned (see `Rolling.steps`), are
    s, which must be 0; of bases that are steered gear·c ∓ radius·δθ, which must not be negative;
    and c ∓ track/2·δθ, what wheels go, if they have a limit.

    Args:
        rolling: The limits of the base.
        path: z_0..z_N, shape (n, N + 1), of which z_1..z_N are variables.
        gears: Shape (N,).
        width: How many variables a waypoint has; the first three are the base's.

    Attributes:
        values, jacobian: Of the rows, step by step.
        owners: The waypoints at which steps end, counted from 0, one for each row.
    """

    def __init__(self, rolling: Rolling, path: ca.MX, gears: ca.MX, *, width: int) -> None:
        self.rolling, self.segments, self.size = (
            rolling,
            path.shape[1] - 1,
            width * (path.shape[1] - 1),
        )
        value, jacobian, self._hessian = _step_functions(rolling)
        self.rows, every = value.size1_out(0), np.arange(self.segments)
        self._inputs = [ca.vertcat(path[:3, :-1], path[:3, 1:]), gears.T]
        before = (every[:, None, None] + [[-1], [0]]) * width + np.arange(3)
        self._columns = before.reshape(-1, 6)  # of both poses in x, where the start has none
        self.owners = np.repeat(every, self.rows)
        self.values = ca.vec(value.map(self.segments)(*self._inputs))
        row, column = (np.array(part) for part in jacobian.sparsity_out(0).get_triplet())
        slopes = jacobian.map(self.segments)(*self._inputs)
        self.jacobian = self._placed(
            slopes, every[:, None] * self.rows + row, self._columns[:, column], len(self.owners)
        )

    def hessian(self, multipliers: ca.MX) -> ca.MX:
        """Return the upper half of the Hessian of the rows, times their multipliers."""
        row, column = (np.array(part) for part in self._hessian.sparsity_out(0).get_triplet())
        bends = self._hessian.map(self.segments)(
            *self._inputs, ca.reshape(multipliers, self.rows, self.segments)
        )
        return self._placed(bends, self._columns[:, row], self._columns[:, column], self.size)

    def _placed(self, parts: ca.MX, row: Ints, column: Ints, height: int) -> ca.MX:
        """Return the matrix of the nonzeros of every step, without those of the start."""
        at = np.stack([row.ravel(), column.ravel()])
        kept = (at >= 0).all(axis=0)
        nonzeros = ca.vertcat(
            *(part.nz[:] for part in ca.horzsplit(parts, parts.shape[1] // self.segments))
        )
        return assemble([nonzeros[np.flatnonzero(kept).tolist()]], [at[:, kept]], height, self.size)

    def bounds(self, dt: Floats | None) -> tuple[Floats, Floats]:
        """Return the bounds of the rows; wheels have some only where steps take times dt, shape (N,) [s]."""
        far = np.full(self.segments, np.inf) if dt is None else self.rolling.rim * dt
        lower, upper = np.zeros((self.segments, self.rows)), np.zeros((self.segments, self.rows))
        upper[:, 1:] = np.inf
        if self.rolling.timed:
            lower[:, -2:], upper[:, -2:] = -far[:, None], far[:, None]
        return lower.ravel(), upper.ravel()


def _step_functions(rolling: Rolling) -> tuple[ca.Function, ca.Function, ca.Function]:
    """Return the SX functions of one step: its rows, their Jacobian, and the upper half of their Hessian times multipliers."""
    poses, gear = ca.SX.sym("b", 6), ca.SX.sym("g")
    dx, dy, turn = ca.vertsplit(poses[3:] - poses[:3])
    heading = (poses[2] + poses[5]) / 2
    along, aside = (
        ca.cos(heading) * dx + ca.sin(heading) * dy,
        ca.cos(heading) * dy - ca.sin(heading) * dx,
    )
    steered = (
        [gear * along + side * rolling.radius * turn for side in (-1, 1)] if rolling.radius else []
    )
    wheels = [along + side * rolling.track / 2 * turn for side in (-1, 1)] if rolling.timed else []
    rows = ca.vertcat(aside, *steered, *wheels)
    multipliers = ca.SX.sym("lam", rows.numel())
    hessian = ca.triu(ca.hessian(ca.dot(multipliers, rows), poses)[0])
    return (
        ca.Function("roll", [poses, gear], [rows], {"cse": True}),
        ca.Function("roll_jacobian", [poses, gear], [ca.jacobian(rows, poses)], {"cse": True}),
        ca.Function("roll_hessian", [poses, gear, multipliers], [hessian], {"cse": True}),
    )


class _Sweep:
    """One sweep over a model's joints, for all kinds of waypoints: z, planes → placements, slopes of the planes' values."""

    def __init__(self, model: pin.Model, slots: int, cache: Cache) -> None:
        coordinates = Coordinates(model)
        z, planes = (
            ca.SX.sym("z", coordinates.size),
            ca.SX.sym("C", slots, 12 * (model.njoints - 1)),
        )
        placements = kinematics_of(model, cache).symbolic(z)
        self.function = ca.Function(
            "sweep", [z, planes], [placements, _slopes(model, coordinates, z, placements, planes)]
        )
        self.nbytes = size_of(self.function)


def _slopes(
    model: pin.Model, coordinates: Coordinates, z: Any, placements: Any, planes: Any
) -> Any:
    """Return the derivatives of planes·vec(M(z)), shape (K, n), with respect to z.

    A coordinate of a joint turns and shifts all that this joint carries by one twist (ω, v): dR = ω
    × R, dt = ω × t + v. So a plane's derivative is m·ω + f·v, where m = Σ (Σ_c R_c × C_c + t × C_t)
    and f = Σ C_t add up over what the joint carries: a fraction of the work of multiplying with the
    derivatives of all placements. Where it moves several joints, each adds its own twist to that of
    those before it, and these add up.
    """
    forces: list[Any] = []
    moments: list[Any] = []
    for joint in range(model.njoints - 1):
        block, placement = planes[:, 12 * joint : 12 * joint + 12], placements[:, joint]
        columns = [(placement[3 * c : 3 * c + 3], block[:, 3 * c : 3 * c + 3]) for c in range(4)]
        forces.append(block[:, 9:])
        moments.append(sum(_cross_rows(point, force) for point, force in columns))
    for joint in reversed(range(model.njoints - 1)):
        parent = model.parents[joint + 1] - 1
        if parent >= 0:
            forces[parent] += forces[joint]
            moments[parent] += moments[joint]
    slopes, twists = [ca.SX(planes.shape[0], 1)] * coordinates.size, dict[tuple[int, int], Any]()
    for column, joint, *_ in coordinates.moves:
        placement = placements[:, joint - 1]
        change = ca.jacobian(placement, z[column])
        turns = [
            ca.cross(placement[3 * c : 3 * c + 3], change[3 * c : 3 * c + 3]) for c in range(3)
        ]
        omega = sum(turns, ca.SX(3, 1)) / 2
        twist = twists[column, joint] = ca.vertcat(
            omega, change[9:] - ca.cross(omega, placement[9:])
        )
        above = [k for k in model.supports[joint] if (column, k) in twists and k != joint]
        own = twist - twists[column, above[-1]] if above else twist
        slopes[column] = slopes[column] + (
            moments[joint - 1] @ own[:3] + forces[joint - 1] @ own[3:]
        )
    return ca.horzcat(*slopes)


def _cross_rows(point: Any, rows: Any) -> Any:
    """Return point × row of each of the K `rows`, shape (K, 3)."""
    x, y, z = point[0], point[1], point[2]
    return ca.horzcat(
        y * rows[:, 2] - z * rows[:, 1],
        z * rows[:, 0] - x * rows[:, 2],
        x * rows[:, 1] - y * rows[:, 0],
    )
