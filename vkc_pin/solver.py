"""Ipopt inside the sequential witness-plane loop (DESIGN: exact ℓ1 slack, trust region, warm starts)."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vkc_pin.contact import Contacts
from vkc_pin.problem import TrajectoryProblem

__all__ = ["Iteration", "Solution", "solve"]

_IPOPT: Mapping[str, Any] = {
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.linear_solver": "mumps",
    "ipopt.tol": 1e-4,
    "ipopt.acceptable_tol": 1e-3,
    "ipopt.constr_viol_tol": 1e-5,
    "ipopt.mu_init": 1e-2,
    "ipopt.nlp_scaling_method": "none",
}
_WARM: Mapping[str, Any] = {
    "ipopt.warm_start_init_point": "yes",
    "ipopt.warm_start_bound_push": 1e-6,
    "ipopt.warm_start_bound_frac": 1e-6,
    "ipopt.warm_start_slack_bound_push": 1e-6,
    "ipopt.warm_start_slack_bound_frac": 1e-6,
    "ipopt.warm_start_mult_bound_push": 1e-6,
    "ipopt.mu_init": 1e-3,
}
CLOSE_ENOUGH = 5e-4  # [m] shortfall of clearance at waypoints that ends the loop
SMALL_STEP = 5e-2  # [m] or [rad] change of the waypoints below which a round counts as converged
POSE_TOLERANCE = 1e-4  # [m] and [rad]
RATE_TOLERANCE = 1e-4  # relative
PENALTY_GROWTH, PENALTY_LIMIT = 4.0, 2000.0


@dataclass(frozen=True)
class Iteration:
    """One round of the witness-plane loop, as the callback sees it.

    Attributes:
        round: Counted from 1.
        iterations: Ipopt iterations so far.
        objective: f of eq. 1.
        clearance: Smallest distance at waypoints [m]; infinite if nothing is within reach.
        shortfall: What is missing to the clearance that is asked for [m].
        pose_error: Largest residual of closure and goals, [m] or [rad].
        step: Largest change of a coordinate in this round.
        radius: Trust region of this round.
        penalty: Weight of the clearance slack.
        time: Since the solver began [s].
    """

    round: int
    iterations: int
    objective: float
    clearance: float
    shortfall: float
    pose_error: float
    step: float
    radius: float
    penalty: float
    time: float


@dataclass
class Solution:
    """What the solver found; whether it is a success only `validation` can say.

    Attributes:
        z: z_1..z_N, shape (N, n), the best iterate.
        converged: Whether the loop ended by its own criteria.
        status: "converged", "not converged", "time limit" or "interrupted".
        rounds, iterations: Of the outer loop and of Ipopt.
        timings: Seconds in "coal", "casadi" (evaluating functions) and "ipopt" (all the rest of it).
        history: One `Iteration` per round.
    """

    z: NDArray[np.float64]
    converged: bool = False
    status: str = "not converged"
    rounds: int = 0
    iterations: int = 0
    timings: dict[str, float] = field(default_factory=lambda: {"coal": 0.0, "casadi": 0.0, "ipopt": 0.0})
    history: list[Iteration] = field(default_factory=list)


class _Loop:
    def __init__(self, problem: TrajectoryProblem, seed: NDArray[np.float64]) -> None:
        self.problem, self.options = problem, problem.options
        self.transcription = problem.transcription
        self.z = problem.clip(seed)
        self.slack = np.zeros(problem.segments)
        self.multipliers: dict[str, Any] = {}
        self.rates = False
        self.penalty = problem.options.penalty
        self.solution = Solution(self.z)
        self.targets = problem.target_matrix()
        self.extra: list[Contacts] = []

    def contacts(self, z: NDArray[np.float64]) -> Contacts:
        begin = time.perf_counter()
        found = self.problem.evaluate_contacts(z, reach=self.options.contact_reach, nearest=self.options.contact_slots)
        self.solution.timings["coal"] += time.perf_counter() - begin
        return found

    def run_ipopt(self, contacts: Contacts | None, radius: float) -> tuple[NDArray[np.float64], NDArray[np.float64], float, bool]:
        """Solve once with fixed planes; return waypoints, g, objective and whether Ipopt was satisfied."""
        problem, t = self.problem, self.transcription
        begin = time.perf_counter()
        if contacts is None:
            joints = self.problem.chain.model.njoints - 1
            planes, offsets = np.zeros((t.segments, t.slots, 12 * joints)), np.full((t.segments, t.slots), -1.0)
        else:
            planes, offsets = problem.contacts.planes(self.z, contacts, slots=t.slots)
        self.solution.timings["coal"] += time.perf_counter() - begin
        lower, upper = problem.lower, problem.upper
        if np.isfinite(radius):
            lower, upper = np.maximum(lower, self.z - radius), np.minimum(upper, self.z + radius)
        bounds = self._row_bounds()
        options = {**_IPOPT, **(_WARM if self.multipliers else {}), "ipopt.max_iter": self.options.max_iterations}
        solver = t.solver(rates=self.rates, options=options)
        arguments = {
            "x0": np.column_stack([self.z, self.slack]).ravel(),
            "lbx": np.column_stack([lower, np.zeros(t.segments)]).ravel(),
            "ubx": np.column_stack([upper, np.full(t.segments, np.inf)]).ravel(),
            "lbg": bounds[0],
            "ubg": bounds[1],
            "p": t.parameter_vector(problem.start, planes, offsets, self.targets, self.penalty),
        }
        begin = time.perf_counter()
        result = solver(**arguments, **self.multipliers)
        total = time.perf_counter() - begin
        stats = solver.stats()
        casadi_time = sum(value for key, value in stats.items() if key.startswith("t_wall_nlp_"))
        self.solution.timings["casadi"] += casadi_time
        self.solution.timings["ipopt"] += total - casadi_time
        self.solution.iterations += int(stats["iter_count"])
        self.multipliers = {"lam_x0": result["lam_x"], "lam_g0": result["lam_g"]}
        x = np.asarray(result["x"]).reshape(t.segments, t.n + 1)
        self.slack = np.maximum(x[:, -1], 0.0)
        g = np.asarray(result["g"]).ravel()
        self.status = stats["return_status"]
        return x[:, :-1], g, float(result["f"]), bool(stats["success"])

    def _row_bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        t = self.transcription
        lower, upper = np.zeros(t.rows), np.zeros(t.rows)
        upper[t.slot_rows] = np.inf
        if self.rates:
            velocity = np.tile(self.problem.velocity, t.segments)
            acceleration = np.tile(self.problem.acceleration, t.second.shape[0])
            rates = np.concatenate([velocity, acceleration])
            lower, upper = np.concatenate([lower, -rates]), np.concatenate([upper, rates])
        return lower, upper

    def pose_error(self, g: NDArray[np.float64]) -> float:
        rows = [r for waypoints in self.transcription.pose_rows for r in waypoints.values()]
        return float(np.abs(g[np.concatenate(rows)]).max()) if rows else 0.0


def solve(
    problem: TrajectoryProblem,
    seed: NDArray[np.float64],
    *,
    callback: Callable[[Iteration], None] | None = None,
    deadline: float = np.inf,
) -> Solution:
    """Return the trajectory that the witness-plane loop reaches from `seed`.

    Args:
        problem: What to solve.
        seed: z_1..z_N, shape (N, n).
        callback: Called after every round.
        deadline: Value of `time.perf_counter()` at which to stop with the best iterate.
    """
    loop, options = _Loop(problem, seed), problem.options
    solution, started = loop.solution, time.perf_counter()
    radius, before, best = np.inf, np.inf, np.inf
    contacts: Contacts | None = None
    for round_ in range(options.max_outer):
        if time.perf_counter() > deadline:
            solution.status = "time limit"
            break
        z, g, objective, satisfied = loop.run_ipopt(contacts, radius)
        step = float(np.abs(z - loop.z).max())
        contacts = loop.contacts(z)
        shortfall, pose_error = contacts.violation(), loop.pose_error(g)
        rate = problem.rate_violation(z)
        solution.rounds = round_ + 1
        row = Iteration(
            solution.rounds, solution.iterations, objective, contacts.clearance(), shortfall, pose_error, step, radius, loop.penalty,
            time.perf_counter() - started,
        )  # fmt: skip
        solution.history.append(row)
        if callback is not None:
            callback(row)
        if round_ > 0:
            if shortfall > before + 1e-3:
                radius = 0.4 * min(radius, step)
            else:
                radius = 0.7 * step if np.isinf(radius) else radius * (1.2 if shortfall < 0.5 * before else 0.8)
            radius = max(radius, 1e-3)
        merit = shortfall + pose_error + max(rate, 0.0)
        if merit < best:
            best, solution.z = merit, z
        loop.z, before = z, shortfall
        if rate > RATE_TOLERANCE and not loop.rates:
            loop.rates, loop.multipliers = True, {}
            continue
        if shortfall < CLOSE_ENOUGH and pose_error < POSE_TOLERANCE and satisfied and (step < SMALL_STEP or round_ == 0):
            solution.converged, solution.status, solution.z = True, "converged", z
            break
        if shortfall > 1e-3 and loop.slack.max() > 1e-3 and round_ > 1:
            loop.penalty = min(loop.penalty * PENALTY_GROWTH, PENALTY_LIMIT)
    return solution
