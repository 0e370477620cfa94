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

__all__ = ["Step", "Subproblem", "make_linear_solver_options"]

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
    """Solution of a subproblem.

    Attributes:
        z: z_1..z_N, shape (N, n).
        slack: Clearance violation at each waypoint according to the planes, shape (N,) [m].
        relaxation: Fraction of the other violations that remains, shape (N,).
        succeeded: Whether Ipopt reported success.
    """

    z: Floats
    slack: Floats
    relaxation: Floats
    succeeded: bool


class Subproblem:
    """Solves the subproblems of one problem with Ipopt, with warm starts from round to round.

    Args:
        problem: Problem.
        solution: Record of iterations and times.
    """

    def __init__(self, problem: TrajectoryProblem, solution: Solution) -> None:
        self.problem, self.solution = problem, solution
        self._targets = problem.target_matrix()
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

        Args:
            z: Iterate z_1..z_N, shape (N, n).
            at: Contacts of the iterate.
            found: Constraint violations of the iterate.
            merit: Merit function with its penalty weights.
            timing: Time steps.
            radius: Trust-region radius at each waypoint, shape (N,) [m] or [rad].
            rates: Whether velocity and acceleration limits are constraints.
        """
        problem, t = self.problem, self.problem.transcription
        begin = time.perf_counter()
        planes, offsets = problem.contacts.compute_planes(z, at, slots=t.slots)
        self.solution.timings["coal"] += time.perf_counter() - begin
        lower, upper = (
            np.maximum(problem.lower, z - radius[:, None]),
            np.minimum(problem.upper, z + radius[:, None]),
        )
        bounds = problem.row_bounds(timing if rates else None)
        relaxed = found.max_violation > TOLERANCE
        # While rows are relaxed, those of the last round differ and its solution need not be exact.
        if relaxed:
            self.reset_multipliers()
        mode = _ROUGH if relaxed else _WARM if self._multipliers else {}
        options = {
            "ipopt.max_iter": problem.options.max_iterations,
            **make_linear_solver_options(),
            **_IPOPT,
            **mode,
        }
        solver = t.solver(rates=rates, options=options)
        penalties = merit.compute_penalty(found, clearance=False)
        relaxation = np.where(relaxed & (penalties > 0.0), 1.0, 0.0)
        parameters = t.parameter_vector(
            problem.start,
            planes,
            offsets,
            self._targets,
            weights=problem.motion_cost.weights(*problem.rates(z)),
            penalty=merit.weights["clearance"],
            dt=timing.dt,
            pose_offsets=found.pose_offsets,
            excess=found.excess,
            relaxation_weights=penalties,
            gears=problem.rolling.compute_gears(problem.waypoints(z)),
        )
        shortfall = compute_shortfalls(at, t.segments, t.slots)
        # Planes whose margin holds get no slack: it must hold after the step, too.
        slack_limit = np.where(shortfall > 0.0, np.inf, 0.0)
        arguments = {
            "x0": t.pack(z, shortfall, relaxation),
            "lbx": t.pack(lower),
            "ubx": t.pack(upper, slack_limit, relaxation),
            "lbg": bounds[0],
            "ubg": bounds[1],
            "p": np.concatenate([parameters, found.rate_excess]),
        }
        begin = time.perf_counter()
        result = solver(**arguments, **self._multipliers)
        total = time.perf_counter() - begin
        self.solution.timings["casadi"] += solver.evaluation_time
        self.solution.timings["ipopt"] += total - solver.evaluation_time
        self.solution.iterations += int(solver.stats["iter_count"])
        self._multipliers = {"lam_x0": result["lam_x"], "lam_g0": result["lam_g"]}
        x = result["x"].reshape(t.segments, t.width)
        slack = np.maximum(x[:, t.n : -1].sum(axis=1), 0.0)
        relaxation = np.clip(x[:, -1], 0.0, 1.0)
        return Step(x[:, : t.n], slack, relaxation, bool(solver.stats["success"]))
