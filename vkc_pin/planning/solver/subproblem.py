"""Builds the subproblem of one round, with fixed planes and a trust region, and solves it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from vkc_pin.planning.chain.contacts import Contacts
from vkc_pin.planning.nlp.merit import TOLERANCE, Infeasibility, Merit, compute_shortfalls
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.nlp.timing import Timing
from vkc_pin.planning.solver.solution import Solution
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.optional_imports import import_compiled

_IPOPT: Mapping[str, Any] = {
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
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
_ROUGH: Mapping[str, Any] = {
    "ipopt.mu_init": 1.0,
    "ipopt.tol": 1e-2,
    "ipopt.acceptable_tol": 1e-1,
    "ipopt.acceptable_iter": 3,
    "ipopt.max_iter": 40,
}


def make_linear_solver_options() -> dict[str, Any]:
    """Return the options that make Ipopt use `_kkt`, through the interface of HSL's MA27.

    Raises:
        BuildError: The module cannot be imported.
    """
    return {
        "ipopt.linear_solver": "ma27",
        "ipopt.hsllib": import_compiled("vkc_pin.planning.solver._kkt").__file__,
        "ipopt.linear_system_scaling": "none",
        "ipopt.ma27_la_init_factor": 1.0,  # the factorization is not stored in Ipopt's arrays
    }


class Step(NamedTuple):
    """Solution of a subproblem."""

    z: Floats  # z_1..z_N, shape (N, n)
    slack: Floats  # clearance violation per waypoint according to the planes, shape (N,) [m]
    relaxation: Floats  # fraction of the other violations that remains, shape (N,)
    succeeded: bool  # whether Ipopt reported success


class Subproblem:
    """Solves the subproblems of one problem with Ipopt, with warm starts from round to round.

    It adds its iterations and times to `solution`.
    """

    def __init__(self, problem: TrajectoryProblem, solution: Solution) -> None:
        self.problem = problem
        self.solution = solution
        self._multipliers: dict[str, Any] = {}

    def reset_multipliers(self) -> None:
        """Discard the last multipliers, which do not fit changed rows or penalty weights."""
        self._multipliers = {}

    def solve(
        self,
        z: Floats,
        at: Contacts,
        found: Infeasibility,
        merit: Merit,
        timing: Timing,
        radius: Floats,
        *,
        rates: bool,
    ) -> Step:
        """Minimize the model of the merit function in the trust region.

        The variables are waypoints x_t with |x_t − z_t| ≤ r_t, slacks s_t and relaxations e_t. To
        the quadratic model of f (see `MotionCost.weights`) it adds the penalties

            Σ_t (ν_c Σ_k s_tk + e_t Σ_{j≠c} ν_j v_jt(z))

        The iterate z, with its shortfalls as slacks and e = 1, satisfies all rows.

        Args:
            z: Iterate z_1..z_N, shape (N, n).
            at: Contacts of the iterate.
            found: Constraint violations of the iterate.
            merit: Merit function.
            timing: Step durations.
            radius: Trust-region radius at each waypoint, shape (N,) [m] or [rad].
            rates: Whether velocity and acceleration limits are constraints.
        """
        problem = self.problem
        t = problem.transcription
        begin = time.perf_counter()
        planes, offsets = problem.contacts.compute_planes(z, at, slots=t.slots)
        self.solution.timings["coal"] += time.perf_counter() - begin
        lower = np.maximum(problem.lower, z - radius[:, None])
        upper = np.minimum(problem.upper, z + radius[:, None])
        lower_rows, upper_rows = problem.row_bounds(timing if rates else None)
        is_relaxed = found.max_violation > TOLERANCE
        # While rows are relaxed, those of the last round differ and its solution need not be exact.
        if is_relaxed:
            self.reset_multipliers()
        options: dict[str, Any] = {"ipopt.max_iter": problem.options.max_iterations}
        options.update(make_linear_solver_options())
        options.update(_IPOPT)
        if is_relaxed:
            options.update(_ROUGH)
        elif self._multipliers:
            options.update(_WARM)
        solver = t.solver(rates=rates, options=options)
        penalties = merit.compute_penalty(found, clearance=False)
        # Waypoints without violation, and all once nothing is violated, must satisfy the rows.
        max_relaxation = np.where(is_relaxed & (penalties > 0.0), 1.0, 0.0)
        parameters = t.parameter_vector(
            planes=planes,
            offsets=offsets,
            penalty=merit.weights["clearance"],
            pose_offsets=found.pose_offsets,
            excess=found.excess,
            relaxation_weights=penalties,
            **problem.parameters_at(z, timing.dt),
        )
        shortfall = compute_shortfalls(at, t.segments, t.slots)
        # Planes whose margin holds get no slack: it must hold after the step, too.
        slack_limit = np.where(shortfall > 0.0, np.inf, 0.0)
        begin = time.perf_counter()
        result = solver(
            x0=t.pack(z, shortfall, max_relaxation),
            lbx=t.pack(lower),
            ubx=t.pack(upper, slack_limit, max_relaxation),
            lbg=lower_rows,
            ubg=upper_rows,
            p=np.concatenate([parameters, found.rate_excess]),
            **self._multipliers,
        )
        total = time.perf_counter() - begin
        self.solution.timings["casadi"] += solver.evaluation_time
        self.solution.timings["ipopt"] += total - solver.evaluation_time
        self.solution.iterations += int(solver.stats["iter_count"])
        self._multipliers = {"lam_x0": result["lam_x"], "lam_g0": result["lam_g"]}
        x = result["x"].reshape(t.segments, t.width)
        slack = np.maximum(x[:, t.n : -1].sum(axis=1), 0.0)
        relaxation = np.clip(x[:, -1], 0.0, 1.0)
        return Step(x[:, : t.n], slack, relaxation, bool(solver.stats["success"]))
