"""Transcribes a trajectory into a symbolic nonlinear program, built once per structure and cached.

The variables are the waypoints after the start, each with one clearance slack per witness plane and
one relaxation variable e: x = (z_1, s_1, e_1, ..., z_N, s_N, e_N). With e = 1 the waypoint may
violate all its other constraints by as much as the iterate at which the program was set up; with e
= 0 they hold exactly. Slacks and relaxation variables are penalised in the objective, which makes
it an exact ℓ1 penalty function. Whatever differs between two tasks of the same structure is a
parameter or a bound: start, velocities at the ends, targets, witness planes, penalty weights. The
rows come from one small SX function per kind of waypoint, mapped over the waypoints. Its exact
Hessian is that of λᵀ·C·vec(M(z)) plus the pose rows, regardless of the number of witness planes.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from vkc_pin.planning.chain.pose import POSE_OFFSET_SIZE
from vkc_pin.planning.kinematics.machine_code import MachineCode
from vkc_pin.planning.nlp.ipopt import BYTES_PER_ENTRY, Ipopt, make_ipopt
from vkc_pin.planning.nlp.objective import find_change_steps
from vkc_pin.planning.nlp.sparse import assemble, make_curvature, make_differences, make_sparse
from vkc_pin.planning.nlp.term_rows import TermProgram
from vkc_pin.planning.nlp.waypoint import StepRows, Structure, get_waypoint_functions
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.utils.budget import record_evaluations
from vkc_pin.utils.cache import Cache


class Transcription:
    """Symbols, functions and Ipopt solvers of the program of one `Structure`, reused between tasks.

    Attributes:
        n, segments, slots: Sizes n, N and K.
        width, size: Number of variables per waypoint, n + K + 1, and in total, N·(n + K + 1).
        rows: Number of constraint rows without the rate rows.
        slot_rows: Rows of the witness planes, shape (N, K).
        pose_rows: For each pose, waypoint → its rows; see `pose.build_pose_rows`.
        base_rows, pushed_rows: Rows of a wheeled base, see `StepRows`, and of pushed coordinates.
        term_rows: For each user-defined term, waypoint → its rows; empty for costs.
        term_values: Function of x, z_0 and the step durations → values of these rows, their
            Jacobian, and the sum and gradient of the costs.
        first_relaxed_row: First of the rows that do not come from waypoint functions: rolling,
            clamping and user-defined constraints.
        row_waypoints, rate_waypoints: Waypoint, counted from 0, whose relaxation variable widens
            the bounds of each of these rows and of the rate rows.
        relaxed_row_values: Function of x, z_0, step durations and gears → values of these rows.
        rate_matrix, rate_start, rate_ends: Velocities and accelerations per step are rate_matrix·x
            + rate_start·z_0 + rate_ends·u, with the steps u of the velocities at both ends.
    """

    def __init__(self, structure: Structure, cache: Cache) -> None:
        self.structure = structure
        self.cache = cache
        self.n = structure.tree.coordinates.size
        self.segments = structure.segments
        self.slots = structure.slots
        self.width = self.n + self.slots + 1
        self.size = self.segments * self.width
        self.uncompiled_functions: list[MachineCode] = []
        self._make_symbols()
        for part in (self._make_objective, self._make_constraints, self._make_rates):
            record_evaluations()
            part()

    @property
    def nbytes(self) -> int:
        """Estimated size in memory [bytes]."""
        nonzeros = self.jacobian.nnz() + self.hessian.nnz()
        return BYTES_PER_ENTRY * nonzeros

    def _make_symbols(self) -> None:
        n = self.n
        N = self.segments
        K = self.slots
        tree = self.structure.tree
        joints = tree.model.njoints - 1
        poses = max(len(self.structure.poses), 1)
        self.x = ca.MX.sym("x", self.size)
        self.waypoint_variables = ca.reshape(self.x, self.width, N)  # one column per waypoint
        self.z = self.waypoint_variables[:n, :]
        self.start = ca.MX.sym("z0", n)
        self.end_steps = ca.MX.sym("u", n, 2)
        self.planes = ca.MX.sym("C", K * 12 * joints, N)
        self.offsets = ca.MX.sym("R", K, N)
        self.targets = ca.MX.sym("W", 12, poses)
        self.frames = ca.MX.sym("L", 12, poses)
        self.mounts = ca.MX.sym("P", 12, tree.mount_count)
        self.pose_offsets = ca.MX.sym("D", POSE_OFFSET_SIZE * poses, N)
        self.penalty = ca.MX.sym("rho")
        self.relaxation_weights = ca.MX.sym("p", N)
        self.gears = ca.MX.sym("gear", N)
        self.dt = ca.MX.sym("dt", N)

    def parameter_vector(self, **values: Floats | float) -> Floats:
        """Return the parameters of the program.

        Args:
            **values: Parameters by name; those that are not given are zero.

                - start: z_0, shape (n,).
                - end_steps: Steps of the velocities at both ends, see `sparse.Differences`,
                  shape (2, n).
                - planes, offsets: Witness planes C, shape (N, K, 12·joints), and R, shape (N, K).
                - targets, frames: Targets of the poses, and placements of their frames on the
                  joints, shape (poses, 12).
                - mounts: Placements of the mounted joints, see `KinematicTree.mounts`.
                - step_weights, change_weights: See `MotionCost.weights`.
                - penalty: Penalty weight of the clearance slacks [1/m].
                - pose_offsets: See `pose.compute_pose_offsets`, shape (N, poses, 7).
                - relaxation_weights: Penalty of each relaxation variable, shape (N,).
                - excess: Bound violations of the relaxed rows at the iterate.
                - gears: Gear of a wheeled base in each step, shape (N,).
                - dt: Step durations, shape (N,) [s].
        """
        columns = {"planes": (0, 2, 1), "step_weights": (1, 0), "change_weights": (1, 0)}
        parts = []
        for name, symbol in self.parameter_symbols.items():
            value = np.asarray(values.get(name, ()))
            if not value.size:
                value = np.zeros(symbol.numel())
            elif name in columns:  # matrices are stored column by column
                value = value.transpose(columns[name])
            parts.append(value.ravel())
        return np.concatenate(parts)

    def pack(
        self, z: Floats, slack: Floats | float = 0.0, relaxations: Floats | float = 0.0
    ) -> Floats:
        """Return x for z, shape (N, n), slacks, shape (N, K) [m], and relaxations, shape (N,)."""
        slack = np.broadcast_to(slack, (len(z), self.slots))
        return np.column_stack([z, slack, relaxations * np.ones(len(z))]).ravel()

    def _make_objective(self) -> None:
        """Build the objective: weighted squared steps and changes, and the penalties.

        With the matrices of `Differences`, the steps S = D z + d z_0 and their changes S' = E z +
        e z_0 + U u (one column for each coordinate), weights w and v of their squares, and the
        penalties ρ of slacks s and p of relaxation variables e,

            f = Σ w S² + Σ v S'² + ρ Σ s + Σ_t p_t e_t
            ∇_z f = 2 Dᵀ(w S) + 2 Eᵀ(v S')
        """
        n = self.n
        N = self.segments
        self.differences = make_differences(N, self.structure.stops)
        first, second, start_first, start_second, end_second = self.differences
        self.step_weights = ca.MX.sym("w", N, n)
        self.change_weights = ca.MX.sym("v", len(second), n)
        slack_penalties = ca.repmat(self.penalty, self.slots, N)
        penalties = ca.vertcat(slack_penalties, self.relaxation_weights.T)
        self.f = ca.dot(penalties, self.waypoint_variables[n:, :])
        gradient = ca.MX(N, n)
        steps = make_sparse(first) @ self.z.T + ca.DM(start_first) @ self.start.T
        changes = make_sparse(second) @ self.z.T + ca.DM(start_second) @ self.start.T
        changes += make_sparse(end_second) @ self.end_steps.T
        for matrix, difference, weights in (
            (first, steps, self.step_weights),
            (second, changes, self.change_weights),
        ):
            self.f += ca.dot(weights, difference**2)
            gradient += 2 * make_sparse(matrix.T) @ (weights * difference)
        self.gradient = ca.vec(ca.vertcat(gradient.T, penalties))
        # Coordinates do not mix: the same pairs of waypoints for each of the n coordinates.
        (row, column), (by_steps, by_changes) = make_curvature([first, second])
        coordinates = np.arange(n)[:, None]
        rows = row * self.width + coordinates
        columns = column * self.width + coordinates
        at = np.stack([rows.ravel(), columns.ravel()])
        curvature = by_steps @ self.step_weights + by_changes @ self.change_weights
        self.objective_curvature = assemble([ca.vec(curvature)], [at], self.size, self.size)

    def _make_constraints(self) -> None:
        """Build all rows but those of rates, their Jacobian and the Hessian of λᵀ·rows."""
        self._make_waypoint_rows()
        self.base_rows = np.zeros(0, int)
        self.first_relaxed_row = self.rows  # these do not come from waypoint functions
        self.row_waypoints = np.zeros(0, int)
        self.remaining_rows = ca.MX(0, 1)
        if not self.structure.rolling.is_omnidirectional:
            self._append_rolling_rows()
        self._append_clamping_rows()
        self.term_rows: list[dict[int, Ints]] = []
        if self.structure.terms:
            self._append_term_rows()
        self._relax_remaining_rows()

    def _make_waypoint_rows(self) -> None:
        """Build the rows of eqs. 2, 3, 6 and 7, waypoint by waypoint.

        The rows of waypoint t begin with its K witness planes, followed by those of its poses. All
        waypoints with the same poses are of one kind: one function, mapped over them.
        """
        N = self.segments
        K = self.slots
        poses_at: list[tuple[int, ...]] = [() for _ in range(N)]
        for index, pose in enumerate(self.structure.poses):
            for waypoint in pose.waypoints:
                poses_at[waypoint - 1] += (index,)
        row_counts = [K + sum(self.structure.poses[k].rows for k in poses) for poses in poses_at]
        first_row = np.concatenate([[0], np.cumsum(row_counts)])
        self.rows = int(first_row[-1])
        self.slot_rows = first_row[:-1, None] + np.arange(K)
        self.pose_rows: list[dict[int, Ints]] = [{} for _ in self.structure.poses]
        self.multipliers = ca.MX.sym("lam_g", self.rows)
        values = []
        value_rows = []
        jacobians = []
        jacobian_at = []
        hessians = []
        hessian_at = []
        for poses in sorted(set(poses_at)):
            at = [t for t in range(N) if poses_at[t] == poses]
            pose_rows = tuple(self.structure.poses[k] for k in poses)
            kind = get_waypoint_functions(self.structure.tree, K, pose_rows, self.cache)
            self.uncompiled_functions += kind.use_machine_code(len(at))
            inputs = self._select_inputs(poses, at)
            rows = first_row[at][:, None] + np.arange(kind.rows)
            multipliers = ca.reshape(self.multipliers[rows.ravel().tolist()], kind.rows, len(at))
            values.append(ca.vec(kind.value.map(len(at))(*inputs)))
            value_rows.append(rows.ravel())
            jacobians.append(ca.vec(kind.jacobian.map(len(at))(*inputs)))
            hessians.append(ca.vec(kind.hessian.map(len(at))(*inputs, multipliers)))

            begin_row = first_row[at][:, None]
            begin_column = np.array(at)[:, None] * self.width
            row, column = kind.jacobian_pattern
            jacobian_at.append(
                np.stack([(begin_row + row).ravel(), (begin_column + column).ravel()])
            )
            row, column = kind.hessian_pattern
            hessian_at.append(
                np.stack([(begin_column + row).ravel(), (begin_column + column).ravel()])
            )
            for t in at:
                begin = first_row[t] + K
                for index, height in zip(poses, kind.pose_rows, strict=True):
                    self.pose_rows[index][t + 1] = begin + np.arange(height)
                    begin += height
        order = np.argsort(np.concatenate(value_rows))
        self.g = ca.vertcat(*values)[order.tolist()]
        self.jacobian = assemble(jacobians, jacobian_at, self.rows, self.size)
        self.hessian = assemble(hessians, hessian_at, self.size, self.size)

    def _select_inputs(self, poses: tuple[int, ...], at: list[int]) -> list[ca.MX]:
        """Return the inputs of `WaypointFunctions` at waypoints (from 0), one column each.

        Functions without poses take one unused target and frame.
        """
        used = list(poses) or [0]
        offset_rows = [POSE_OFFSET_SIZE * k + i for k in used for i in range(POSE_OFFSET_SIZE)]
        constants = [self.targets[:, used], self.frames[:, used], self.mounts]
        targets, frames, mounts = (ca.repmat(ca.vec(each), 1, len(at)) for each in constants)
        return [
            self.waypoint_variables[:, at],
            self.planes[:, at],
            self.offsets[:, at],
            targets,
            self.pose_offsets[offset_rows, at],
            frames,
            mounts,
        ]

    def _append_rows(self, values: ca.MX, jacobian: ca.MX, row_waypoints: Ints) -> ca.MX:
        """Append rows with their Jacobian and waypoints (from 0); return their multipliers."""
        rows = self.rows  # before these
        self.row_waypoints = np.concatenate([self.row_waypoints, row_waypoints])
        self.remaining_rows = ca.vertcat(self.remaining_rows, values)
        self.g = ca.vertcat(self.g, values)
        self.jacobian = ca.vertcat(self.jacobian, jacobian)
        self.rows += values.numel()
        multipliers = ca.MX.sym("lam_g", self.rows)
        (self.hessian,) = ca.substitute([self.hessian], [self.multipliers], [multipliers[:rows]])
        self.multipliers = multipliers
        return multipliers[rows:]

    def _append_rolling_rows(self) -> None:
        """Append the rolling rows of a wheeled base, step by step."""
        path = ca.horzcat(self.start, self.z)
        steps = StepRows(self.structure.rolling, path, self.gears, width=self.width)
        self.steps = steps
        self.base_rows = self.rows + np.arange(len(steps.waypoints))
        multipliers = self._append_rows(steps.values, steps.jacobian, steps.waypoints)
        self.hessian = self.hessian + steps.hessian(multipliers)

    def _append_clamping_rows(self) -> None:
        """Append z_t − z_{t−1} = 0 for clamped and ±(z_t − z_{t−1}) ≥ 0 for pushed coordinates."""
        # waypoint t, column and sign of each step from waypoint t to t + 1
        steps = list[tuple[int, int, int]]()
        for column, first, last in self.structure.clamped:
            steps += [(t, column, 1) for t in range(first, last)]
        clamped_count = len(steps)
        for column, first, last, direction in self.structure.pushed:
            steps += [(t, column, direction) for t in range(first, last)]
        pushed_count = len(steps) - clamped_count
        self.pushed_rows = self.rows + clamped_count + np.arange(pushed_count)
        if not steps:
            return
        by_start = ca.DM(len(steps), self.n)
        by_variables = ca.DM(len(steps), self.size)
        for row, (t, column, sign) in enumerate(steps):
            by_variables[row, t * self.width + column] = sign
            if t > 0:
                by_variables[row, (t - 1) * self.width + column] = -sign
            else:
                by_start[row, column] = -sign
        values = by_start @ self.start + by_variables @ self.x
        self._append_rows(values, by_variables, np.array([t for t, _, _ in steps]))

    def _append_term_rows(self) -> None:
        """Append the user-defined constraints and add the user-defined costs to the objective."""
        dt = self.dt if self.structure.is_timed else ca.MX.zeros(self.segments)
        part = TermProgram(
            self.structure.tree,
            self.structure.terms,
            ca.horzcat(self.start, self.z),
            dt,
            self.mounts,
            self.cache,
            self.width,
        )
        for rows_by_waypoint in part.rows_by_waypoint:
            self.term_rows.append(
                {waypoint: self.rows + rows for waypoint, rows in rows_by_waypoint.items()}
            )
        outputs = [part.values, part.jacobian, part.cost, part.gradient]
        inputs = [self.x, self.start, self.dt, self.mounts]
        self.term_values = ca.Function("terms", inputs, outputs)
        multipliers = self._append_rows(part.values, part.jacobian, part.row_waypoints)
        self.hessian = self.hessian + part.hessian(multipliers)
        self.f = self.f + part.cost
        self.gradient = self.gradient + part.gradient
        self.objective_curvature = self.objective_curvature + part.cost_hessian

    def _relax_remaining_rows(self) -> None:
        """Relax the rows that do not come from waypoint functions, and collect all parameters."""
        self.excess = ca.MX.sym("r", self.rows - self.first_relaxed_row)
        inputs = [self.x, self.start, self.dt, self.gears, self.mounts]
        self.relaxed_row_values = ca.Function("others", inputs, [self.remaining_rows])
        if len(self.row_waypoints):
            rows = np.arange(self.first_relaxed_row, self.rows)
            self.g, self.jacobian = self._subtract_relaxation(
                self.g, self.jacobian, rows, self.row_waypoints, self.excess
            )
        self.parameter_symbols = {
            "start": self.start,
            "end_steps": self.end_steps,
            "planes": self.planes,
            "offsets": self.offsets,
            "targets": self.targets,
            "frames": self.frames,
            "mounts": self.mounts,
            "step_weights": self.step_weights,
            "change_weights": self.change_weights,
            "penalty": self.penalty,
            "pose_offsets": self.pose_offsets,
            "relaxation_weights": self.relaxation_weights,
            "excess": self.excess,
        }
        if not self.structure.rolling.is_omnidirectional:
            self.parameter_symbols["gears"] = self.gears
        if self.structure.is_timed:
            self.parameter_symbols["dt"] = self.dt
        self.parameters = ca.veccat(*self.parameter_symbols.values())

    def _subtract_relaxation(
        self, g: ca.MX, jacobian: ca.MX, rows: Ints, row_waypoints: Ints, excess: ca.MX
    ) -> tuple[ca.MX, ca.MX]:
        """Return rows and Jacobian with excess times relaxation subtracted from `rows`."""
        positions = np.stack([rows, row_waypoints * self.width + self.width - 1])
        reduction = assemble([excess], [positions], g.numel(), self.size)
        return g - reduction @ self.x, jacobian - reduction

    def _make_rates(self) -> None:
        """Build the matrices of eq. 5: velocities and accelerations per step."""
        n = self.n
        identity = ca.DM.eye(n)
        # of a waypoint's variables the coordinates, without slacks and relaxation variable
        select = ca.horzcat(identity, ca.DM(n, self.slots + 1))
        differences = self.differences
        steps = ca.kron(make_sparse(differences.first), select)
        changes = ca.kron(make_sparse(differences.second), select)
        self.rate_matrix = ca.vertcat(steps, changes)
        steps_of_start = ca.kron(make_sparse(differences.start_first[:, None]), identity)
        changes_of_start = ca.kron(make_sparse(differences.start_second[:, None]), identity)
        self.rate_start = ca.vertcat(steps_of_start, changes_of_start)
        changes_of_ends = ca.kron(make_sparse(differences.end_second), identity)
        self.rate_ends = ca.vertcat(ca.DM(steps.size1(), 2 * n), changes_of_ends)
        change_steps = find_change_steps(self.structure.stops, self.segments)
        self.rate_waypoints = np.repeat([*range(self.segments), *change_steps], n)

    def solver(self, *, rates: bool, options: dict[str, Any]) -> Ipopt:
        """Return an Ipopt solver of this program with the given options of CasADi's nlpsol.

        With `rates`, velocity and acceleration rows are appended to the rows, and their excess to
        the parameters.
        """
        key = ("ipopt", self.structure.key, rates, tuple(sorted(options.items())))
        return self.cache.get(key, lambda: self._make_solver(rates, options))

    def _make_solver(self, rates: bool, options: dict[str, Any]) -> Ipopt:
        g = self.g
        jacobian = self.jacobian
        multipliers = self.multipliers
        parameters = self.parameters
        weight = ca.MX.sym("lam_f")
        n_rows = self.rows
        hessian = weight * self.objective_curvature + self.hessian
        if rates:
            rate_rows = self.rate_matrix @ self.x + self.rate_start @ self.start
            rate_rows += self.rate_ends @ ca.vec(self.end_steps)
            g = ca.vertcat(g, rate_rows)
            jacobian = ca.vertcat(jacobian, self.rate_matrix)
            multipliers = ca.MX.sym("lam", g.numel())
            excess = ca.MX.sym("r", rate_rows.numel())
            # Rates are linear: the Hessian stays the same.
            g, jacobian = self._subtract_relaxation(
                g, jacobian, np.arange(n_rows, g.numel()), self.rate_waypoints, excess
            )
            parameters = ca.vertcat(parameters, excess)
            (hessian,) = ca.substitute([hessian], [self.multipliers], [multipliers[:n_rows]])
        return make_ipopt(
            self.x,
            parameters,
            (self.f, self.gradient),
            (g, jacobian),
            (weight, multipliers, hessian),
            options,
            waypoints=self.segments,
        )


def transcribe(structure: Structure, cache: Cache) -> Transcription:
    """Return the program of `structure`, rebuilt if machine code has become available since."""
    key = ("program", structure.key)
    program = cache.get(key, lambda: Transcription(structure, cache))
    if not program.uncompiled_functions:
        return program
    if not all(code.try_load() for code in program.uncompiled_functions):
        return program
    cache.evict(*key)
    cache.evict("ipopt", structure.key)
    return cache.get(key, lambda: Transcription(structure, cache))
