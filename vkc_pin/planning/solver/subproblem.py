"""The program of one round, with fixed planes and in a trust region, and Ipopt on it."""

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
from vkc_pin.utils.optional_imports import compiled_module

__all__ = ["Step", "Subproblem", "linear_solver"]

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


def linear_solver() -> dict[str, Any]:
    """Return the options with which Ipopt has its systems factored by `_kkt`, which it speaks to as to HSL's MA27.

    Raises:
        BuildError: The module cannot be imported.
    """
    return {
        "ipopt.linear_solver": "ma27",
        "ipopt.hsllib": compiled_module("vkc_pin.planning.solver._kkt").__file__,
        "ipopt.linear_system_scaling": "none",
        "ipopt.ma27_la_init_factor": 1.0,  # what is factored is not in Ipopt's arrays
    }


class Step(NamedTuple):
    """Where a subproblem leads.

    Attributes:
        z: z_1..z_N, shape (N, n).
        slack: What the planes let be missing of clearance at every waypoint, shape (N,) [m].
        shares: The share that stays of what was missing else, shape (N,).
        satisfied: Whether Ipopt was.
    """

    z: Floats
    slack: Floats
    shares: Floats
    satisfied: bool


class Subproblem:
    """Ipopt on the programs of one problem, round after round.

    Args:
        problem: The problem.
        solution: Where iterations and times are counted.
    """

    def __init__(self, problem: TrajectoryProblem, solution: Solution) -> None:
        self.problem, self.solution = problem, solution
        self._targets = problem.target_matrix()
        self._multipliers: dict[str, Any] = {}

    def forget(self) -> None:
        """Begin the next round without the multipliers of the last: rows or weights are others."""
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
        """Return the minimum of the merit's model in the trust region.

        Args:
            z: The iterate, z_1..z_N, shape (N, n).
            at: What is close there.
            found: What does not hold there.
            merit: The weights.
            timing: How long steps take.
            radius: Of the trust region at every waypoint, shape (N,).
            rates: Whether limits on velocity and acceleration are rows.
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
        if (
            relaxed
        ):  # on the way: the rows of the round before were others, and its end need not be exact
            self.forget()
        how = _ROUGH if relaxed else _WARM if self._multipliers else {}
        options = {
            "ipopt.max_iter": problem.options.max_iterations,
            **linear_solver(),
            **_IPOPT,
            **how,
        }
        solver = t.solver(rates=rates, options=options)
        penalties = merit.compute_penalty(found, clearance=False)
        shares = np.where(relaxed & (penalties > 0.0), 1.0, 0.0)
        parameters = t.parameter_vector(
            problem.start,
            planes,
            offsets,
            self._targets,
            weights=problem.effort.weights(*problem.rates(z)),
            penalty=merit.weights["clearance"],
            dt=timing.dt,
            pose_offsets=found.pose_offsets,
            excess=found.excess,
            relaxation_weights=penalties,
            gears=problem.rolling.compute_gears(problem.waypoints(z)),
        )
        short = compute_shortfalls(at, t.segments, t.slots)
        room = np.where(short > 0.0, np.inf, 0.0)  # what keeps its margin now must go on keeping it
        arguments = {
            "x0": t.pack(z, short, shares),
            "lbx": t.pack(lower),
            "ubx": t.pack(upper, room, shares),
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
        slack, shares = np.maximum(x[:, t.n : -1].sum(axis=1), 0.0), np.clip(x[:, -1], 0.0, 1.0)
        return Step(x[:, : t.n], slack, shares, bool(solver.stats["success"]))
