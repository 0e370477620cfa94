"""The symbolic nonlinear program of a trajectory, built once per structure and kept.

Variables are the waypoints after the start, each with one clearance slack: x = (z_1, s_1, ..., z_N, s_N). Everything
that differs between two tasks of one structure is a parameter or a bound: start, placements to reach, witness planes,
penalty. Rows belong to one waypoint each and derive from one small SX function per kind of waypoint, mapped over the
waypoints; its exact Hessian is that of λᵀ·C·vec(M(z)) plus the pose rows, whatever the number of witness planes.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from vkc_pin.arrays import Floats, Ints
from vkc_pin.cache import Cache
from vkc_pin.chain.inverse_kinematics import PoseSolver
from vkc_pin.models.coordinates import Coordinates
from vkc_pin.program.deadline import Monitor
from vkc_pin.program.sparse import assemble, sparse, unit
from vkc_pin.program.term_rows import TermProgram
from vkc_pin.program.waypoint import Structure, waypoint_functions

__all__ = ["Transcription", "transcribe"]

_ENTRY = 600  # [bytes] that an entry of Jacobian or Hessian takes, in a program and in a solver, measured at the door


class _Ipopt(NamedTuple):
    """A solver, and what stops it."""

    solver: ca.Function
    monitor: Monitor | None
    nbytes: int


class Transcription:
    """The program of one `Structure`: symbols, functions and Ipopt solvers, reused between tasks.

    Attributes:
        structure: What it was built of.
        n, segments, slots: Sizes n, N and K.
        size: Number of variables N·(n + 1).
        rows: Number of constraint rows without the rate rows.
        slot_rows: Rows of the witness planes, shape (N, K).
        pose_rows: For each pose, waypoint → its rows; see `pose.pose_rows`.
        base_rows: Rows that keep a differential base from slipping, shape (N,); empty for others.
        term_rows: For each of the user's own constraints, waypoint → its rows; costs have none. They are the last rows.
        term_values: x, z_0 and times of all steps → values of these rows, their Jacobian, and the sum and slope of the costs.
        pose_solvers: Inverse kinematics of each pose.
        rate_matrix, rate_start: Velocities and accelerations per step are rate_matrix·x + rate_start·z_0.
    """

    def __init__(self, structure: Structure, cache: Cache) -> None:
        self.structure, self.cache = structure, cache
        self.n, self.segments, self.slots = Coordinates(structure.model).size, structure.segments, structure.slots
        self.size = self.segments * (self.n + 1)
        self._symbols()
        self._objective()
        self._constraints()
        self._rates()
        self.pose_solvers = [PoseSolver(structure.model, pose, cache) for pose in structure.poses]

    @property
    def nbytes(self) -> int:
        """Its size in memory, estimated [bytes]."""
        return _ENTRY * (self.jacobian.nnz() + self.hessian.nnz()) + sum(solver.nbytes for solver in self.pose_solvers)

    def _symbols(self) -> None:
        n, N, K, joints = self.n, self.segments, self.slots, self.structure.model.njoints - 1
        self.x = ca.MX.sym("x", self.size)
        blocks = ca.reshape(self.x, n + 1, N)
        self.z, self.s = blocks[:n, :], blocks[n, :]
        self.start = ca.MX.sym("z0", n)
        self.planes = ca.MX.sym("C", K * 12 * joints, N)
        self.offsets = ca.MX.sym("R", K, N)
        self.targets = ca.MX.sym("W", 12, max(len(self.structure.poses), 1))
        self.penalty = ca.MX.sym("rho")
        self.dt = ca.MX.sym("dt", N)
        times = [self.dt] if self.structure.timed else []
        self.parameters = ca.veccat(self.start, self.planes, self.offsets, self.targets, self.penalty, *times)

    def parameter_vector(
        self, start: Floats, planes: Floats, offsets: Floats, targets: Floats, *, penalty: float, dt: Floats | None = None
    ) -> Floats:
        """Return the parameters: start (n,), planes (N, K, 12·joints), offsets (N, K), targets (poses, 12), penalty, dt (N,).

        The times of the steps only count where a term needs them.
        """
        planes = planes.transpose(0, 2, 1).ravel()  # the K × 12J matrix of a waypoint, column by column
        padded = targets.ravel() if len(targets) else np.zeros(12)
        times = [dt] if self.structure.timed and dt is not None else []
        return np.concatenate([start, planes, offsets.ravel(), padded, [penalty], *times])

    def rows_at(self, x: Floats, parameters: Floats) -> tuple[Floats, Any]:
        """Return the rows at x, shape (rows,), and their Jacobian, a sparse matrix (SciPy) of shape (rows, size)."""
        rows, jacobian = ca.Function("rows", [self.x, self.parameters], [self.g, self.jacobian])(x, parameters)
        return np.asarray(rows).ravel(), jacobian.sparse().tocsr()

    def patterns(self) -> tuple[Any, Any]:
        """Return where the rows' Jacobian and the Lagrangian's Hessian have entries, as sparse matrices (SciPy) of ones."""
        upper = ca.triu(self.objective_hessian).sparsity() + self.hessian.sparsity()
        return ca.DM(self.jacobian.sparsity(), 1.0).sparse(), ca.DM(upper + upper.T, 1.0).sparse()

    def _objective(self) -> None:
        """Make the objective of eq. 1: f = ½ xᵀHx + gᵀx + c."""
        n, N = self.n, self.segments
        first = np.eye(N) - np.eye(N, k=-1)  # δz_t = z_t − z_{t−1}
        start_first = np.zeros(N)
        start_first[0] = -1.0
        # The velocity steps between segments, and from and to rest where the motion starts, pauses and ends.
        stops = [0, *self.structure.stops, N]
        runs = [np.diff(np.eye(N)[begin:end], axis=0, prepend=0.0, append=0.0) for begin, end in itertools.pairwise(stops)]
        steps = np.vstack(runs)
        second, start_second = steps @ first, steps @ start_first
        self.first, self.second, self.start_first, self.start_second = first, second, start_first, start_second
        hessian, linear = ca.DM(self.size, self.size), ca.DM(self.size, n)
        for i, (v, a) in enumerate(zip(self.structure.weights_velocity.T, self.structure.weights_acceleration, strict=True)):
            curvature = first.T @ (v[:, None] * first) + a * second.T @ second
            slope = first.T @ (v * start_first) + a * second.T @ start_second
            hessian += ca.kron(sparse(2 * curvature), unit(n + 1, n + 1, i))
            linear += ca.kron(sparse(2 * slope[:, None]), unit(n + 1, n, i))
        self.objective_hessian, linear_matrix = hessian, linear
        self.objective_curvature: Any = ca.triu(hessian)
        slack = np.zeros((N, n + 1))
        slack[:, n] = 1.0
        gradient = linear_matrix @ self.start + self.penalty * ca.DM(slack.ravel())
        constant = ca.dot(self.start, self._start_weight() * self.start)
        product = ca.mtimes(self.objective_hessian, self.x)
        self.f = 0.5 * ca.dot(self.x, product) + ca.dot(gradient, self.x) + constant
        self.gradient = product + gradient

    def _start_weight(self) -> ca.DM:
        v, a = self.structure.weights_velocity, self.structure.weights_acceleration
        return ca.DM(self.start_first**2 @ v + a * (self.start_second @ self.start_second))

    def _constraints(self) -> None:
        """Make the rows of eqs. 2, 3, 6 and 7, waypoint by waypoint, their Jacobian and the Hessian of λᵀ·rows."""
        n, N, K = self.n, self.segments, self.slots
        poses_at: list[tuple[int, ...]] = [() for _ in range(N)]
        for index, pose in enumerate(self.structure.poses):
            for waypoint in pose.waypoints:
                poses_at[waypoint - 1] += (index,)
        kinds = sorted(set(poses_at))
        count = [K + sum(self.structure.poses[k].rows for k in poses) for poses in poses_at]
        first_row = np.concatenate([[0], np.cumsum(count)])
        self.rows = int(first_row[-1])
        self.slot_rows = first_row[:-1, None] + np.arange(K)
        self.pose_rows: list[dict[int, Ints]] = [{} for _ in self.structure.poses]
        values, jacobians, hessians = [], [], []
        value_rows, jacobian_at, hessian_at = [], [], []
        self.multipliers = ca.MX.sym("lam_g", self.rows)
        for poses in kinds:
            at = [t for t in range(N) if poses_at[t] == poses]
            kind = waypoint_functions(self.structure.model, K, tuple(self.structure.poses[k] for k in poses), self.cache)
            targets = ca.repmat(ca.vec(self.targets[:, list(poses)] if poses else self.targets[:, 0]), 1, len(at))
            inputs = [self.z[:, at], self.s[:, at], self.planes[:, at], self.offsets[:, at], targets]
            rows = first_row[at][:, None] + np.arange(kind.rows)
            multipliers = ca.reshape(self.multipliers[rows.ravel().tolist()], kind.rows, len(at))
            values.append(ca.vec(kind.value.map(len(at))(*inputs)))
            jacobians.append(ca.vec(kind.jacobian.map(len(at))(*inputs)))
            hessians.append(ca.vec(kind.hessian.map(len(at))(*inputs, multipliers)))
            value_rows.append(rows.ravel())
            offset = np.array(at)[:, None] * (n + 1)
            row, column = (np.array(part) for part in kind.jacobian_pattern)
            jacobian_at.append(np.stack([(first_row[at][:, None] + row).ravel(), (offset + column).ravel()]))
            row, column = (np.array(part) for part in kind.hessian_pattern)
            hessian_at.append(np.stack([(offset + row).ravel(), (offset + column).ravel()]))
            place = K
            for index, height in zip(poses, kind.pose_rows, strict=True):
                for t in at:
                    self.pose_rows[index][t + 1] = first_row[t] + place + np.arange(height)
                place += height
        order = np.argsort(np.concatenate(value_rows))
        self.g = ca.vertcat(*values)[order.tolist()]
        self.jacobian = assemble(jacobians, jacobian_at, self.rows, self.size)
        self.hessian = assemble(hessians, hessian_at, self.size, self.size)
        self.base_rows = np.zeros(0, int)
        if self.structure.differential:
            self._differential()
        self._clamp()
        self.term_rows: list[dict[int, Ints]] = []
        if self.structure.terms:
            self._terms()

    def _append(self, values: ca.MX, jacobian: ca.MX) -> ca.MX:
        """Append rows with their Jacobian, and return their multipliers."""
        rows = self.rows
        self.g, self.jacobian, self.rows = ca.vertcat(self.g, values), ca.vertcat(self.jacobian, jacobian), rows + values.numel()
        multipliers = ca.MX.sym("lam_g", self.rows)
        (self.hessian,) = ca.substitute([self.hessian], [self.multipliers], [multipliers[:rows]])
        self.multipliers = multipliers
        return multipliers[rows:]

    def _differential(self) -> None:
        """Append −sin θ̄·δx + cos θ̄·δy at every segment's mid-heading: the base rolls, it does not slip."""
        z = ca.horzcat(self.start, self.z)
        heading, step = (z[2, 1:] + z[2, :-1]) / 2, z[:2, 1:] - z[:2, :-1]
        slip = (-ca.sin(heading) * step[0, :] + ca.cos(heading) * step[1, :]).T
        self.base_rows = self.rows + np.arange(self.segments)
        multipliers = self._append(slip, ca.jacobian(slip, self.x))
        extra = ca.MX.sym("lam_slip", self.segments)
        (curvature,) = ca.substitute([ca.triu(ca.hessian(ca.dot(extra, slip), self.x)[0])], [extra], [multipliers])
        self.hessian = self.hessian + curvature

    def _clamp(self) -> None:
        """Append z_t − z_{t−1} = 0 for what a clamping hand does not let slide."""
        pairs = [(c, t) for c, first, last in self.structure.clamped for t in range(first + 1, last + 1)]
        if not pairs:
            return
        difference = ca.DM(len(pairs), self.size)
        for row, (column, waypoint) in enumerate(pairs):
            difference[row, (waypoint - 1) * (self.n + 1) + column] = 1.0
            difference[row, (waypoint - 2) * (self.n + 1) + column] = -1.0
        self._append(difference @ self.x, difference)

    def _terms(self) -> None:
        """Append the user's own constraints, and add their costs to the objective."""
        dt = self.dt if self.structure.timed else ca.MX.zeros(self.segments)
        part = TermProgram(self.structure.model, self.structure.terms, ca.horzcat(self.start, self.z), dt, self.cache)
        self.term_rows = [{waypoint: self.rows + rows for waypoint, rows in at.items()} for at in part.at]
        outputs = [part.values, part.jacobian, part.cost, part.gradient]
        self.term_values = ca.Function("terms", [self.x, self.start, self.dt], outputs)
        multipliers = self._append(part.values, part.jacobian)
        self.hessian = self.hessian + part.hessian(multipliers)
        self.f, self.gradient = self.f + part.cost, self.gradient + part.gradient
        self.objective_curvature = self.objective_curvature + part.cost_hessian

    def _rates(self) -> None:
        """Make the matrices of eq. 5: velocities and accelerations per step."""
        n = self.n
        select, identity = ca.horzcat(ca.DM.eye(n), ca.DM(n, 1)), ca.DM.eye(n)  # leaves the slack out
        self.rate_matrix = ca.vertcat(*(ca.kron(sparse(part), select) for part in (self.first, self.second)))
        starts = (self.start_first[:, None], self.start_second[:, None])
        self.rate_start = ca.vertcat(*(ca.kron(sparse(part), identity) for part in starts))

    def solver(self, *, rates: bool, options: dict[str, Any], deadline: float = np.inf) -> ca.Function:
        """Return Ipopt on this program.

        Args:
            rates: Whether velocity and acceleration rows follow the others.
            options: For CasADi's nlpsol.
            deadline: Value of `time.perf_counter()` at which it stops; applies to the solver's next call.
        """
        timed = bool(np.isfinite(deadline))
        key = ("ipopt", self.structure.key, rates, timed, tuple(sorted(options.items())))
        found = self.cache.get(key, lambda: self._make_solver(rates, timed, options))
        if found.monitor is not None:
            found.monitor.deadline = deadline
        return found.solver

    def _make_solver(self, rates: bool, timed: bool, options: dict[str, Any]) -> _Ipopt:
        g, jacobian, multipliers = self.g, self.jacobian, self.multipliers
        if rates:
            g = ca.vertcat(g, self.rate_matrix @ self.x + self.rate_start @ self.start)
            jacobian = ca.vertcat(jacobian, self.rate_matrix)
            multipliers = ca.MX.sym("lam", g.numel())
        weight = ca.MX.sym("lam_f")
        hessian = weight * self.objective_curvature + self.hessian
        if rates:
            (hessian,) = ca.substitute([hessian], [self.multipliers], [multipliers[: self.rows]])
        inputs = [self.x, self.parameters]
        functions = {
            "grad_f": ca.Function("nlp_grad_f", inputs, [self.f, self.gradient], ["x", "p"], ["f", "grad_f_x"]),
            "jac_g": ca.Function("nlp_jac_g", inputs, [g, jacobian], ["x", "p"], ["g", "jac_g_x"]),
            "hess_lag": ca.Function(
                "nlp_hess_l", [*inputs, weight, multipliers], [hessian], ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"]
            ),
        }
        quiet = {"print_time": False, "record_time": True, "calc_lam_p": False, "no_nlp_grad": True}
        program = {"x": self.x, "p": self.parameters, "f": self.f, "g": g}
        monitor = Monitor(self.size, g.numel(), self.parameters.numel()) if timed else None
        callback = {"iteration_callback": monitor} if timed else {}
        solver = ca.nlpsol("trajectory", "ipopt", program, {**quiet, **functions, **callback, **options})
        return _Ipopt(solver, monitor, _ENTRY * (jacobian.nnz() + hessian.nnz()))


def transcribe(structure: Structure, cache: Cache) -> Transcription:
    """Return the program of `structure`, built if it is not in the cache."""
    return cache.get(("program", structure.key), lambda: Transcription(structure, cache))
