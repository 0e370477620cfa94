"""The symbolic nonlinear program of a trajectory, built once per structure and kept.

Variables are the waypoints after the start, each with a clearance slack for every witness plane and
a share e of what it is away from all else that is asked for there: x = (z_1, s_1, e_1, ..., z_N,
s_N, e_N). At a share of 1 the waypoint may stay as far away as the iterate is at which the program
was set up, at 0 everything holds; both cost in the objective, so that it is an exact ℓ1 penalty
function of them. What differs between two tasks of one structure is a parameter or a bound: start,
targets, witness planes, penalties. Rows derive from one small SX function per kind of waypoint,
mapped over the waypoints; its exact Hessian is that of λᵀ·C·vec(M(z)) plus the pose rows, whatever
the number of witness planes.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from vkc_pin.planning.chain.inverse_kinematics import PoseSolver
from vkc_pin.planning.chain.pose import AWAY
from vkc_pin.planning.kinematics.machine_code import MachineCode
from vkc_pin.planning.nlp.ipopt import ENTRY, Ipopt, ipopt
from vkc_pin.planning.nlp.objective import changed_at
from vkc_pin.planning.nlp.sparse import assemble, curvature, differences, sparse
from vkc_pin.planning.nlp.term_rows import TermProgram
from vkc_pin.planning.nlp.waypoint import StepRows, Structure, waypoint_functions
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.utils.budget import spend
from vkc_pin.utils.cache import Cache
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.trajectory.wheels import Rolling

__all__ = ["Transcription", "transcribe"]


class Transcription:
    """The program of one `Structure`: symbols, functions and Ipopt solvers, reused between tasks.

    Attributes:
        structure: What it was built of.
        n, segments, slots: Sizes n, N and K.
        width, size: Numbers of variables n + K + 1 of a waypoint and N·(n + K + 1) of all.
        rows: Number of constraint rows without the rate rows.
        slot_rows: Rows of the witness planes, shape (N, K).
        pose_rows: For each pose, waypoint → its rows; see `pose.pose_rows`.
        base_rows: Rows that let a base on wheels roll, see `StepRows`, shape (N·rows of a step,);
            empty for others.
        term_rows: For each of the user's own constraints, waypoint → its rows; costs have none.
            They are the last rows.
        term_values: x, z_0 and times of all steps → values of these rows, their Jacobian, and the
            sum and slope of the costs.
        pose_solvers: Inverse kinematics of each pose.
        firm_rows: Where the rows begin that are not of one waypoint's functions: of rolling,
            clamping and own constraints.
        owners, rate_owners: The waypoints, counted from 0, whose shares lengthen the bounds of
            these and of the rate rows.
        other_values: x, z_0, times and gears of all steps → their values.
        interpreted: Functions of waypoints that were not yet machine code when it was built.
        rate_matrix, rate_start: Velocities and accelerations per step are rate_matrix·x +
            rate_start·z_0.
    """

    def __init__(self, structure: Structure, cache: Cache) -> None:
        self.structure, self.cache = structure, cache
        self.n, self.segments, self.slots = (
            Coordinates(structure.model).size,
            structure.segments,
            structure.slots,
        )
        self.width = self.n + self.slots + 1
        self.size = self.segments * self.width
        self.interpreted: list[MachineCode] = []
        self._symbols()
        for part in (self._objective, self._constraints, self._rates):
            spend()
            part()
        self.pose_solvers = [PoseSolver(structure.model, pose, cache) for pose in structure.poses]

    @property
    def nbytes(self) -> int:
        """Its size in memory, estimated [bytes]."""
        return ENTRY * (self.jacobian.nnz() + self.hessian.nnz()) + sum(
            solver.nbytes for solver in self.pose_solvers
        )

    def _symbols(self) -> None:
        n, N, K = self.n, self.segments, self.slots
        joints, poses = self.structure.model.njoints - 1, max(len(self.structure.poses), 1)
        self.x = ca.MX.sym("x", self.size)
        self.own = ca.reshape(self.x, self.width, N)  # a column for every waypoint
        self.z, self.start, self.dt = self.own[:n, :], ca.MX.sym("z0", n), ca.MX.sym("dt", N)
        self.planes, self.offsets = ca.MX.sym("C", K * 12 * joints, N), ca.MX.sym("R", K, N)
        self.targets, self.away = ca.MX.sym("W", 12, poses), ca.MX.sym("D", AWAY * poses, N)
        self.penalty, self.prices, self.gears = (
            ca.MX.sym("rho"),
            ca.MX.sym("p", N),
            ca.MX.sym("gear", N),
        )

    def parameter_vector(
        self,
        start: Floats,
        planes: Floats,
        offsets: Floats,
        targets: Floats,
        *,
        weights: tuple[Floats, Floats],
        penalty: float,
        dt: Floats | None = None,
        away: Floats | None = None,
        excess: Floats | None = None,
        prices: Floats | None = None,
        gears: Floats | None = None,
    ) -> Floats:
        """Return the parameters. The times of the steps only count where a term needs them.

        Args:
            start: z_0, shape (n,).
            planes: Witness planes C, shape (N, K, 12·joints).
            offsets: Theirs, R, shape (N, K).
            targets: Of the poses, shape (poses, 12).
            weights: Of squared steps and their squared changes, see `Effort.weights`.
            penalty: What a metre of clearance slack costs.
            dt: Times of the steps, shape (N,).
            away: How far frames are from these at the iterate, shape (N, poses, 7), see
                `pose.away_from`; None: not at all.
            excess: By how much other rows are out of their bounds there, shape (rows after those of
                poses,); None: not at all.
            prices: What all of that costs at a waypoint, shape (N,).
            gears: Of the steps of a base on wheels, shape (N,); None: ahead.
        """
        columns = planes.transpose(
            0, 2, 1
        ).ravel()  # the K × 12J matrix of a waypoint, column by column
        padded = targets.ravel() if len(targets) else np.zeros(12)
        away = np.zeros(self.away.numel()) if away is None or not away.size else away.ravel()
        excess = np.zeros(self.excess.numel()) if excess is None else excess
        prices = np.zeros(self.segments) if prices is None else prices
        times = dt if self.structure.timed and dt is not None else np.zeros(0)
        gears = (
            np.zeros(0)
            if self.structure.rolling.aside
            else np.ones(self.segments)
            if gears is None
            else gears
        )
        before = (start, columns, offsets.ravel(), padded, *(part.T.ravel() for part in weights))
        return np.concatenate([*before, [penalty], away, prices, excess, gears, times])

    def pack(self, z: Floats, slack: Floats | float = 0.0, shares: Floats | float = 0.0) -> Floats:
        """Return x of waypoints, shape (N, n), their slacks, shape (N, K), and their shares, shape (N,); or the same for all."""
        slack = np.broadcast_to(slack, (len(z), self.slots))
        return np.column_stack([z, slack, shares * np.ones(len(z))]).ravel()

    def _objective(self) -> None:
        """Make the objective: weighted squares of steps and of their changes, and what slacks and shares cost."""
        n, N = self.n, self.segments
        self.first, self.second, self.start_first, self.start_second = differences(
            N, self.structure.stops
        )
        symbols = self.of_steps, self.of_changes = (
            ca.MX.sym("w", N, n),
            ca.MX.sym("v", len(self.second), n),
        )
        costs = ca.vertcat(ca.repmat(self.penalty, self.slots, N), self.prices.T)
        self.f, slope = ca.dot(costs, self.own[n:, :]), ca.MX(N, n)
        for matrix, start, weights in zip(
            (self.first, self.second), (self.start_first, self.start_second), symbols, strict=True
        ):
            differs = sparse(matrix) @ self.z.T + ca.DM(start) @ self.start.T
            self.f += ca.dot(weights, differs**2)
            slope += 2 * sparse(matrix.T) @ (weights * differs)
        self.gradient = ca.vec(ca.vertcat(slope.T, costs))
        places, (by_steps, by_changes) = curvature([self.first, self.second])
        at = np.stack(places)[:, None, :] * self.width + np.arange(n)[:, None]
        values = [ca.vec(by_steps @ self.of_steps + by_changes @ self.of_changes)]
        self.objective_curvature = assemble(values, [at.reshape(2, -1)], self.size, self.size)

    def _constraints(self) -> None:
        """Make the rows of eqs. 2, 3, 6 and 7, waypoint by waypoint, their Jacobian and the Hessian of λᵀ·rows."""
        N, K = self.segments, self.slots
        poses_at: list[tuple[int, ...]] = [() for _ in range(N)]
        for index, pose in enumerate(self.structure.poses):
            for waypoint in pose.waypoints:
                poses_at[waypoint - 1] += (index,)
        count = [K + sum(self.structure.poses[k].rows for k in poses) for poses in poses_at]
        first_row = np.concatenate([[0], np.cumsum(count)])
        self.rows = int(first_row[-1])
        self.slot_rows = first_row[:-1, None] + np.arange(K)
        self.pose_rows: list[dict[int, Ints]] = [{} for _ in self.structure.poses]
        values, jacobians, hessians = [], [], []
        value_rows, jacobian_at, hessian_at = [], [], []
        self.multipliers = ca.MX.sym("lam_g", self.rows)
        for poses in sorted(set(poses_at)):
            at = [t for t in range(N) if poses_at[t] == poses]
            kind = waypoint_functions(
                self.structure.model, K, tuple(self.structure.poses[k] for k in poses), self.cache
            )
            self.interpreted += kind.hasten(len(at))
            targets = ca.repmat(
                ca.vec(self.targets[:, list(poses)] if poses else self.targets[:, 0]), 1, len(at)
            )
            away = self.away[[AWAY * k + i for k in poses or (0,) for i in range(AWAY)], at]
            inputs = [self.own[:, at], self.planes[:, at], self.offsets[:, at], targets, away]
            rows = first_row[at][:, None] + np.arange(kind.rows)
            multipliers = ca.reshape(self.multipliers[rows.ravel().tolist()], kind.rows, len(at))
            values.append(ca.vec(kind.value.map(len(at))(*inputs)))
            jacobians.append(ca.vec(kind.jacobian.map(len(at))(*inputs)))
            hessians.append(ca.vec(kind.hessian.map(len(at))(*inputs, multipliers)))
            value_rows.append(rows.ravel())
            offset = np.array(at)[:, None] * self.width
            row, column = (np.array(part) for part in kind.jacobian_pattern)
            jacobian_at.append(
                np.stack([(first_row[at][:, None] + row).ravel(), (offset + column).ravel()])
            )
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
        self.firm_rows = self.rows  # those after it are not of one waypoint's functions
        self.owners, self.others = np.zeros(0, int), ca.MX(0, 1)
        if not self.structure.rolling.aside:
            self._roll(self.structure.rolling)
        self._clamp()
        self.term_rows: list[dict[int, Ints]] = []
        if self.structure.terms:
            self._terms()
        self._relax()

    def _append(self, values: ca.MX, jacobian: ca.MX, owners: Ints) -> ca.MX:
        """Append rows with their Jacobian and the waypoints they belong to, counted from 0; return their multipliers."""
        rows, self.owners = self.rows, np.concatenate([self.owners, owners])
        self.others = ca.vertcat(self.others, values)
        self.g, self.jacobian, self.rows = (
            ca.vertcat(self.g, values),
            ca.vertcat(self.jacobian, jacobian),
            rows + values.numel(),
        )
        multipliers = ca.MX.sym("lam_g", self.rows)
        (self.hessian,) = ca.substitute([self.hessian], [self.multipliers], [multipliers[:rows]])
        self.multipliers = multipliers
        return multipliers[rows:]

    def _roll(self, rolling: Rolling) -> None:
        """Append the rows of every step of a base on wheels, step by step."""
        self.steps = StepRows(rolling, ca.horzcat(self.start, self.z), self.gears, width=self.width)
        self.base_rows = self.rows + np.arange(len(self.steps.owners))
        multipliers = self._append(self.steps.values, self.steps.jacobian, self.steps.owners)
        self.hessian = self.hessian + self.steps.hessian(multipliers)

    def _clamp(self) -> None:
        """Append z_t − z_{t−1} = 0 for what a clamping hand does not let slide, and ±(z_t − z_{t−1}) ≥ 0 for what is pushed."""
        steps = [
            (c, t, 1)
            for c, first, last in self.structure.clamped
            for t in range(first + 1, last + 1)
        ]
        pushes = [
            (c, t, way)
            for c, first, last, way in self.structure.pushed
            for t in range(first + 1, last + 1)
        ]
        self.pushed_rows = self.rows + len(steps) + np.arange(len(pushes))
        if not (steps := steps + pushes):
            return
        difference = ca.DM(len(steps), self.n + self.size)  # the start comes first
        for row, (column, t, way) in enumerate(steps):
            difference[row, self.n + (t - 1) * self.width + column] = way
            difference[row, self.n + (t - 2) * self.width + column if t > 1 else column] = -way
        start, own = difference[:, : self.n], difference[:, self.n :]
        self._append(start @ self.start + own @ self.x, own, np.array([t - 1 for _, t, _ in steps]))

    def _terms(self) -> None:
        """Append the user's own constraints, and add their costs to the objective."""
        dt, terms = (
            self.dt if self.structure.timed else ca.MX.zeros(self.segments),
            self.structure.terms,
        )
        part = TermProgram(
            self.structure.model,
            terms,
            ca.horzcat(self.start, self.z),
            dt,
            self.cache,
            width=self.width,
        )
        self.term_rows = [
            {waypoint: self.rows + rows for waypoint, rows in at.items()} for at in part.at
        ]
        outputs = [part.values, part.jacobian, part.cost, part.gradient]
        self.term_values = ca.Function("terms", [self.x, self.start, self.dt], outputs)
        multipliers = self._append(part.values, part.jacobian, part.owners)
        self.hessian = self.hessian + part.hessian(multipliers)
        self.f, self.gradient = self.f + part.cost, self.gradient + part.gradient
        self.objective_curvature = self.objective_curvature + part.cost_hessian

    def _relax(self) -> None:
        """Let the shares of their waypoints lengthen the bounds of the rows that are not of one waypoint's functions."""
        self.excess = ca.MX.sym("r", self.rows - self.firm_rows)
        self.other_values = ca.Function(
            "others", [self.x, self.start, self.dt, self.gears], [self.others]
        )
        if len(self.owners):
            rows = np.arange(self.firm_rows, self.rows)
            self.g, self.jacobian = self._relaxed(
                self.g, self.jacobian, rows, self.owners, self.excess
            )
        given = [
            self.start,
            self.planes,
            self.offsets,
            self.targets,
            self.of_steps,
            self.of_changes,
            self.penalty,
        ]
        given += [self.away, self.prices, self.excess]
        given += [] if self.structure.rolling.aside else [self.gears]
        self.parameters = ca.veccat(*given, *([self.dt] if self.structure.timed else []))

    def _relaxed(
        self, g: ca.MX, jacobian: ca.MX, rows: Ints, owners: Ints, excess: ca.MX
    ) -> tuple[ca.MX, ca.MX]:
        """Return rows and Jacobian, where from `rows` excess times their waypoint's share is taken away."""
        place = np.stack([rows, owners * self.width + self.width - 1])
        less = assemble([excess], [place], g.numel(), self.size)
        return g - less @ self.x, jacobian - less

    def _rates(self) -> None:
        """Make the matrices of eq. 5: velocities and accelerations per step."""
        n = self.n
        select, identity = (
            ca.horzcat(ca.DM.eye(n), ca.DM(n, self.slots + 1)),
            ca.DM.eye(n),
        )  # leaves slack and share out
        self.rate_matrix = ca.vertcat(
            *(ca.kron(sparse(part), select) for part in (self.first, self.second))
        )
        self.rate_owners = np.repeat(
            [*range(self.segments), *changed_at(self.structure.stops, self.segments)], n
        )
        starts = (self.start_first[:, None], self.start_second[:, None])
        self.rate_start = ca.vertcat(*(ca.kron(sparse(part), identity) for part in starts))

    def solver(self, *, rates: bool, options: dict[str, Any]) -> Ipopt:
        """Return Ipopt on this program.

        Args:
            rates: Whether velocity and acceleration rows follow the others, and their excess the
                other parameters.
            options: For CasADi's nlpsol.
        """
        key = ("ipopt", self.structure.key, rates, tuple(sorted(options.items())))
        return self.cache.get(key, lambda: self._make_solver(rates, options))

    def _make_solver(self, rates: bool, options: dict[str, Any]) -> Ipopt:
        g, jacobian, multipliers, parameters = (
            self.g,
            self.jacobian,
            self.multipliers,
            self.parameters,
        )
        weight, firm = ca.MX.sym("lam_f"), self.rows
        hessian = weight * self.objective_curvature + self.hessian
        if rates:
            g = ca.vertcat(g, self.rate_matrix @ self.x + self.rate_start @ self.start)
            jacobian = ca.vertcat(jacobian, self.rate_matrix)
            multipliers, excess = ca.MX.sym("lam", g.numel()), ca.MX.sym("r", g.numel() - firm)
            g, jacobian = self._relaxed(
                g, jacobian, np.arange(firm, g.numel()), self.rate_owners, excess
            )
            parameters = ca.vertcat(parameters, excess)
            (hessian,) = ca.substitute([hessian], [self.multipliers], [multipliers[:firm]])
        lagrangian = (weight, multipliers, hessian)
        return ipopt(
            self.x,
            parameters,
            (self.f, self.gradient),
            (g, jacobian),
            lagrangian,
            options,
            waypoints=self.segments,
        )


def transcribe(structure: Structure, cache: Cache) -> Transcription:
    """Return the program of `structure`, built if it is not in the cache, or if machine code has come since it was built."""
    program = cache.get(key := ("program", structure.key), lambda: Transcription(structure, cache))
    if not program.interpreted or not all(code.look() for code in program.interpreted):
        return program
    cache.drop(*key)
    cache.drop("ipopt", structure.key)
    return cache.get(key, lambda: Transcription(structure, cache))
