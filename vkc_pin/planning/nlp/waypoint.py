"""Builds the constraint rows of one waypoint (eqs. 2, 3, 6, 7) and of one step of a wheeled base.

They are small SX functions with exact second derivatives, mapped over waypoints or steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from vkc_pin.planning.chain.kinematic_tree import KinematicTree, get_kinematics
from vkc_pin.planning.chain.pose import POSE_OFFSET_SIZE, PoseRow, build_pose_rows, relax_target
from vkc_pin.planning.kinematics.batch import estimate_size
from vkc_pin.planning.kinematics.machine_code import MachineCode
from vkc_pin.planning.nlp.sparse import assemble, get_pattern
from vkc_pin.planning.nlp.term_rows import TermRow
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.utils.budget import record_evaluations
from vkc_pin.utils.cache import Cache
from vkc_pin.world.trajectory.wheels import OMNIDIRECTIONAL, RollingLimits

# Minimum number of waypoints of one kind for which compilation pays off. Most kinds occur once, at
# a grasp, or about thirty times.
_MIN_WAYPOINTS_TO_COMPILE = 4


@dataclass(frozen=True, eq=False, kw_only=True)
class Structure:
    """Everything that a symbolic program depends on.

    Attributes:
        tree: Joints of the virtual kinematic chain.
        segments: N, the number of waypoints after the start.
        poses: Frames with a pose goal.
        slots: K, witness planes per waypoint.
        stops: Interior waypoints at which the motion is at rest.
        rolling: Motion constraints of the base.
        clamped: (column, first, last): coordinates that are constant from waypoint `first` to
            `last`, such as the freedoms of a clamped grasp.
        pushed: (column, first, last, direction): coordinates that may only increase (direction 1)
            or decrease (-1) from waypoint `first` to `last`.
        terms: User-defined constraints and costs.
    """

    tree: KinematicTree
    segments: int
    poses: tuple[PoseRow, ...]
    slots: int
    stops: tuple[int, ...] = ()
    rolling: RollingLimits = OMNIDIRECTIONAL
    clamped: tuple[tuple[int, int, int], ...] = ()
    pushed: tuple[tuple[int, int, int, int], ...] = ()
    terms: tuple[TermRow, ...] = ()

    @property
    def is_timed(self) -> bool:
        """Whether any term depends on the step duration."""
        return any(term.formula.uses_time_step for term in self.terms)

    @cached_property
    def key(self) -> tuple[Any, ...]:
        """Cache key, equal for structures that share one program."""
        poses = tuple((*pose.key, pose.waypoints) for pose in self.poses)
        others = (self.stops, self.rolling, self.clamped, self.pushed, self.terms)
        return (self.tree.key, self.segments, poses, self.slots, *others)


def get_waypoint_functions(
    tree: KinematicTree, slots: int, poses: tuple[PoseRow, ...], cache: Cache
) -> WaypointFunctions:
    """Return the functions of one kind of waypoint, built if they are not in the cache."""
    key = ("waypoint", tree.key, slots, *(pose.key for pose in poses))
    return cache.get(key, lambda: WaypointFunctions(tree, slots, poses, cache))


class WaypointFunctions:
    """SX functions of one kind of waypoint: tree, number of witness planes, and pose goals.

    The variables are z, the slacks s and the relaxation e of the waypoint; the arguments beside
    them are planes, targets, and placements of frames and mounted joints. Its rows are the witness
    planes C·vec(M(z)) − R + s, and for each pose goal `build_pose_rows` to the target relaxed by e.

    Attributes:
        value, jacobian, hessian: Rows, nonzeros of their Jacobian, and nonzeros of the upper
            triangle of the Hessian of multipliers·rows, each one column.
        jacobian_pattern, hessian_pattern: Their rows and columns.
        pose_rows: Number of rows of each pose goal.
        rows: Number of all rows.
    """

    def __init__(
        self, tree: KinematicTree, slots: int, poses: tuple[PoseRow, ...], cache: Cache
    ) -> None:
        n = tree.coordinates.size
        joints = tree.model.njoints - 1
        z = ca.SX.sym("z", n)
        s = ca.SX.sym("s", slots)
        relaxation = ca.SX.sym("e")
        planes = ca.SX.sym("C", slots, 12 * joints)
        offsets = ca.SX.sym("R", slots)
        targets = ca.SX.sym("W", 12, max(len(poses), 1))
        pose_offsets = ca.SX.sym("D", POSE_OFFSET_SIZE, max(len(poses), 1))
        frames = ca.SX.sym("L", 12, max(len(poses), 1))
        mounts = ca.SX.sym("P", 12, tree.mount_count)
        sweep = cache.get(("sweep", tree.key, slots), lambda: _KinematicSweep(tree, slots, cache))
        placements, coordinate_jacobian = sweep.function(z, mounts, planes)
        stacked = ca.vec(placements)
        # Every row is linear in the placements, rows = L·vec(M) + const, so one kinematic sweep
        # serves all of them.
        parts = []
        for k, pose in enumerate(poses):
            target = relax_target(targets[:, k], pose_offsets[:, k], relaxation)
            rotation, translation = pose.build_placement(placements, frames[:, k])
            parts.append(build_pose_rows(pose.kind, rotation, translation, target))
        pose_values = ca.vertcat(*parts) if parts else ca.SX(0, 1)
        self.pose_rows = [pose.rows for pose in poses]
        self.rows = slots + sum(self.pose_rows)
        rows = ca.vertcat(planes @ stacked - offsets + s, pose_values)
        multipliers = ca.SX.sym("lam", self.rows)
        # vertsplit, because slicing a scalar would give a row
        plane_multipliers, pose_multipliers = ca.vertsplit(multipliers, [0, slots, self.rows])
        variables = ca.vertcat(z, s, relaxation)
        plane_jacobian = ca.horzcat(coordinate_jacobian, ca.SX.eye(slots), ca.SX(slots, 1))
        jacobian = ca.vertcat(plane_jacobian, ca.jacobian(pose_values, variables))
        record_evaluations()
        # The planes' part of the Lagrangian is λᵀ(C·vec(M) − R + s), of which only w·vec(M) with
        # w = Cᵀλ has second derivatives: their cost does not grow with the number of planes.
        w = ca.SX.sym("w", 12 * joints)
        lagrangian = ca.dot(w, stacked) + ca.dot(pose_multipliers, pose_values)
        hessian = ca.triu(ca.hessian(lagrangian, variables)[0])
        given = [z, relaxation, targets, pose_offsets, frames, mounts]
        inner = ca.Function("inner", [*given, w, multipliers], [hessian])
        hessian = inner(*given, planes.T @ plane_multipliers, multipliers)
        columns = [ca.vec(matrix) for matrix in (targets, pose_offsets, frames, mounts)]
        inputs = [variables, ca.vec(planes), offsets, *columns]
        record_evaluations()
        self.value = ca.Function("g", inputs, [rows])
        self.jacobian = ca.Function("rows_jacobian", inputs, [ca.vertcat(*jacobian.nonzeros())])
        record_evaluations()
        self.jacobian_pattern = get_pattern(jacobian)
        nonzeros = ca.vertcat(*hessian.nonzeros())
        self.hessian = ca.Function("lagrangian_hessian", [*inputs, multipliers], [nonzeros])
        self.hessian_pattern = get_pattern(hessian)
        self.code = MachineCode(self.value, self.jacobian, self.hessian)
        self.nbytes = estimate_size(self.value, self.jacobian, self.hessian)

    def use_machine_code(self, waypoints: int) -> list[MachineCode]:
        """Switch to machine code if it pays off; return the code that is not available yet."""
        if waypoints < _MIN_WAYPOINTS_TO_COMPILE:
            return []
        self.code.try_load()
        self.value, self.jacobian, self.hessian = self.code.functions
        return [] if self.code.is_compiled else [self.code]


class StepRows:
    """Constraint rows of all steps of a wheeled base, from one pose (x, y, yaw) to the next.

    The rows of one step, all in metres, use its longitudinal displacement c, lateral displacement s
    and rotation δθ (see `RollingLimits.compute_steps`): s, which must be zero; for steered bases,
    gear·c ∓ radius·δθ, which must not be negative; and, if the wheel speed is limited, the wheel
    travel c ∓ track/2·δθ. The path z_0..z_N has shape (n, N + 1); the gear of each step is 1
    (forward) or -1 (backward).

    Attributes:
        values, jacobian: Row values and their Jacobian, step by step.
        waypoints: Waypoint at which the step of each row ends, counted from 0.
    """

    def __init__(self, rolling: RollingLimits, path: ca.MX, gears: ca.MX, *, width: int) -> None:
        self.rolling = rolling
        self.segments = path.shape[1] - 1
        self.size = width * self.segments
        self._functions = _StepFunctions(rolling)
        self.rows = self._functions.value.size1_out(0)
        self._inputs = [ca.vertcat(path[:3, :-1], path[:3, 1:]), gears.T]
        steps = np.arange(self.segments)
        # Columns of both poses in x; negative for the start, which is no variable.
        columns_before = (steps[:, None] - 1) * width + np.arange(3)
        columns_after = steps[:, None] * width + np.arange(3)
        self._columns = np.hstack([columns_before, columns_after])
        self.waypoints = np.repeat(steps, self.rows)
        self.values = ca.vec(self._functions.value.map(self.segments)(*self._inputs))
        row, column = self._functions.jacobian_pattern
        slopes = self._functions.jacobian.map(self.segments)(*self._inputs)
        self.jacobian = self._place_nonzeros(
            slopes, steps[:, None] * self.rows + row, self._columns[:, column], len(self.waypoints)
        )

    def hessian(self, multipliers: ca.MX) -> ca.MX:
        """Return the upper triangle of the Hessian of multipliers·rows."""
        row, column = self._functions.hessian_pattern
        multipliers = ca.reshape(multipliers, self.rows, self.segments)
        curvatures = self._functions.hessian.map(self.segments)(*self._inputs, multipliers)
        return self._place_nonzeros(
            curvatures, self._columns[:, row], self._columns[:, column], self.size
        )

    def _place_nonzeros(self, nonzeros: ca.MX, row: Ints, column: Ints, height: int) -> ca.MX:
        """Return the sparse matrix of all steps' nonzeros, one column a step, without the start."""
        positions = np.stack([row.ravel(), column.ravel()])
        is_variable = (positions >= 0).all(axis=0)
        variable_nonzeros = ca.vec(nonzeros)[np.flatnonzero(is_variable).tolist()]
        return assemble([variable_nonzeros], [positions[:, is_variable]], height, self.size)

    def bounds(self, dt: Floats | None) -> tuple[Floats, Floats]:
        """Return the bounds of the rows; `dt`, shape (N,) [s], limits wheel travel if given."""
        travel = np.full(self.segments, np.inf)
        if dt is not None:
            travel = self.rolling.wheel_speed * dt
        lower = np.zeros((self.segments, self.rows))
        upper = np.zeros((self.segments, self.rows))
        upper[:, 1:] = np.inf
        if self.rolling.has_wheel_limit:
            lower[:, -2:] = -travel[:, None]
            upper[:, -2:] = travel[:, None]
        return lower.ravel(), upper.ravel()


class _StepFunctions:
    """SX functions of one step of a wheeled base, of both poses and the gear g.

    With the displacements δx, δy, δθ and the mean heading h = (θ + θ⁺)/2, the step is an arc if its
    chord is parallel to h. Its lateral and longitudinal displacements are

        s = cos h·δy − sin h·δx,   c = cos h·δx + sin h·δy

    and its rows s, g·c ∓ r·δθ and c ∓ b/2·δθ, see `StepRows`.

    Attributes:
        value, jacobian, hessian: Rows, nonzeros of their Jacobian, and nonzeros of the upper
            triangle of the Hessian of multipliers·rows, each one column.
        jacobian_pattern, hessian_pattern: Their rows and columns.
    """

    def __init__(self, rolling: RollingLimits) -> None:
        poses = ca.SX.sym("b", 6)
        gear = ca.SX.sym("g")
        dx, dy, turn = ca.vertsplit(poses[3:] - poses[:3])
        heading = (poses[2] + poses[5]) / 2
        longitudinal = ca.cos(heading) * dx + ca.sin(heading) * dy
        rows = [ca.cos(heading) * dy - ca.sin(heading) * dx]
        if rolling.turning_radius:
            for side in (-1, 1):
                rows.append(gear * longitudinal + side * rolling.turning_radius * turn)
        if rolling.has_wheel_limit:
            for side in (-1, 1):
                rows.append(longitudinal + side * rolling.track / 2 * turn)
        values = ca.vertcat(*rows)
        multipliers = ca.SX.sym("lam", len(rows))
        jacobian = ca.jacobian(values, poses)
        hessian = ca.triu(ca.hessian(ca.dot(multipliers, values), poses)[0])
        # The nonzeros are returned as a column: those of a matrix with a single row would be
        # mapped over the steps in another order.
        slopes = ca.vertcat(*jacobian.nonzeros())
        curvatures = ca.vertcat(*hessian.nonzeros())
        inputs = [poses, gear]
        options = {"cse": True}
        self.value = ca.Function("roll", inputs, [values], options)
        self.jacobian = ca.Function("roll_jacobian", inputs, [slopes], options)
        self.hessian = ca.Function("roll_hessian", [*inputs, multipliers], [curvatures], options)
        self.jacobian_pattern = get_pattern(jacobian)
        self.hessian_pattern = get_pattern(hessian)


class _KinematicSweep:
    """One kinematic sweep for all kinds of waypoints.

    Its function is (z, mounts, planes) → placements, plane gradients.
    """

    def __init__(self, tree: KinematicTree, slots: int, cache: Cache) -> None:
        z = ca.SX.sym("z", tree.coordinates.size)
        mounts = ca.SX.sym("P", 12, tree.mount_count)
        planes = ca.SX.sym("C", slots, 12 * (tree.model.njoints - 1))
        placements = get_kinematics(tree, cache).build_placements(z, mounts)
        gradients = _differentiate_planes(tree, z, placements, planes)
        self.function = ca.Function("sweep", [z, mounts, planes], [placements, gradients])
        self.nbytes = estimate_size(self.function)


def _differentiate_planes(tree: KinematicTree, z: Any, placements: Any, planes: Any) -> Any:
    """Return the derivatives of planes·vec(M(z)), shape (K, n), with respect to z.

    A coordinate of a joint moves everything that the joint supports by one twist (ω, v): dR = ω ×
    R, dt = ω × t + v. The derivative of a plane is therefore m·ω + f·v, where m = Σ (Σ_c R_c × C_c
    + t × C_t) and f = Σ C_t are accumulated over the supported joints. This takes a fraction of the
    work of multiplying by the derivatives of all placements. If a coordinate moves several joints,
    each contributes its twist relative to its nearest ancestor moved by the same coordinate.
    """
    model = tree.model
    coordinates = tree.coordinates
    forces: list[Any] = []
    moments: list[Any] = []
    axes = [slice(0, 3), slice(3, 6), slice(6, 9)]  # columns of R in a placement
    for joint in range(model.njoints - 1):
        block = planes[:, 12 * joint : 12 * joint + 12]
        placement = placements[:, joint]
        forces.append(block[:, 9:])
        moment = 0
        for part in (*axes, slice(9, 12)):
            moment = moment + _cross_rows(placement[part], block[:, part])
        moments.append(moment)
    # Add those of the joints that a joint supports; parents come first.
    for joint in reversed(range(model.njoints - 1)):
        parent = model.parents[joint + 1] - 1
        if parent >= 0:
            forces[parent] += forces[joint]
            moments[parent] += moments[joint]
    slopes = [ca.SX(planes.shape[0], 1)] * coordinates.size
    twists = dict[tuple[int, int], Any]()
    for column, joint, *_ in coordinates.moves:
        placement = placements[:, joint - 1]
        derivative = ca.jacobian(placement, z[column])
        # Each column r of R has r × dr = r × (ω × r) = ω − (r·ω) r; their sum is 2ω.
        turns = [ca.cross(placement[axis], derivative[axis]) for axis in axes]
        omega = sum(turns, ca.SX(3, 1)) / 2
        velocity = derivative[9:] - ca.cross(omega, placement[9:])
        twist = ca.vertcat(omega, velocity)
        twists[column, joint] = twist
        ancestors = [k for k in model.supports[joint] if (column, k) in twists and k != joint]
        relative = twist
        if ancestors:
            relative = twist - twists[column, ancestors[-1]]
        slope = moments[joint - 1] @ relative[:3] + forces[joint - 1] @ relative[3:]
        slopes[column] = slopes[column] + slope
    return ca.horzcat(*slopes)


def _cross_rows(point: Any, rows: Any) -> Any:
    """Return the cross product of `point` with each of the K `rows`, shape (K, 3)."""
    x, y, z = ca.vertsplit(point)
    return ca.horzcat(
        y * rows[:, 2] - z * rows[:, 1],
        z * rows[:, 0] - x * rows[:, 2],
        x * rows[:, 1] - y * rows[:, 0],
    )
