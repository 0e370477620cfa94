"""Plans with trajopt of tesseract: sequential convex optimization with swept collision checks.

The fixed base of a grasped object and the goal pose are pose constraints. Initial guesses are
straight lines to goal configurations, the nearest first.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from vkc_pin.planning.initialization.keyframes import sample_smoothstep
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Floats

from .description import FRAME, GROUP, describe
from .found import Clock, PeerResult
from .processes import start_solver
from .sampled import compute_finite_limits
from .tasks import PeerProblem, sample_goals

_ENDS = 10  # seeds at most
_SHARE = 0.3  # of the time that is left, for one of them
_MARGIN = 0.002  # [m] added to margins, since constraints hold to a tolerance
_PARAMETERS = {
    "max_iterations": 200,
    "initial_trust_box_size": 0.1,
    "cnt_tolerance": 1e-4,
    "min_approx_improve": 1e-3,
    "min_approx_improve_frac": 1e-3,
    "trust_shrink_ratio": 0.2,
    "initial_merit_error_coeff": 10.0,
}


def plan_by_trajopt(
    own: PeerProblem,
    problem: TrajectoryProblem,
    seed: int,
    clock: Clock,
    accept: Callable[[Floats], bool],
) -> PeerResult:
    """Plan with trajopt; see `found.Peer`."""
    worker = start_solver("trajopt", "trajopt_solver")
    goals = sample_goals(problem, np.random.default_rng([seed, 1]), _ENDS)
    if not len(goals):
        return PeerResult(status="no configuration at the goal")
    segments = problem.segments
    found = PeerResult(status="not converged")
    lower, upper = compute_finite_limits(problem)
    goal = problem.pose_goals[0].row
    ask_worker = {
        n.replace(".", "_"): float(problem.lower[-1, k])
        for k, n in enumerate(problem.chain.names)
        if _goal(problem, k)
    }
    with tempfile.TemporaryDirectory() as folder:
        files = describe(problem, Path(folder))
        for row in goals:
            if clock.remaining <= 0.0:
                found.status = "timed out"
                break
            ask = {
                "urdf": str(files.urdf),
                "srdf": str(files.srdf),
                "group": GROUP,
                "frame": FRAME,
                "joints": files.joints,
                "seed": (
                    problem.start
                    + np.append(0.0, sample_smoothstep(segments))[:, None] * (row - problem.start)
                ).tolist(),
                "lower": lower.tolist(),
                "upper": upper.tolist(),
                "weights": np.sqrt(problem.motion_cost.metric).tolist(),
                "target": problem.targets[0].homogeneous.tolist(),
                "at": [int(t) for t in goal.waypoints],
                "goal": ask_worker,
                "margin": _MARGIN,
                "buffer": 0.02,
                "longest": 0.1,
                "contacts": 3,
                "parameters": {**_PARAMETERS, "max_time": max(_SHARE * clock.remaining, 1.0)},
            }
            answer = worker(ask)
            clock.elsewhere += answer["cpu"]
            if "error" in answer:
                found.status = "error"
                found.about["said"] = answer["error"]
                continue
            found.own += answer["own"]
            found.about.setdefault("said", []).append(answer["status"])
            path = np.array(answer["z"])
            path[0] = problem.start
            found.path = path
            found.status = "found" if answer["status"] == "NLP_CONVERGED" else "not converged"
            if accept(path):
                found.first = clock.cpu_time
                break
    return found


def _goal(problem: TrajectoryProblem, column: int) -> bool:
    """Return whether a coordinate has a goal value."""
    last, before = (
        (limits[0][column], limits[1][column])
        for limits in ((problem.lower[-1], problem.upper[-1]), (problem.lower[0], problem.upper[0]))
    )
    return bool(last[0] == last[1] and before[0] != before[1])
