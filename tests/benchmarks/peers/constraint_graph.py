"""Plans with HPP: random trees on the manifold of a constraint graph, then shortcuts.

The fixed base of a grasped object is the constraint of the graph's only state. Clearances are
HPP's security margins, one per pair of bodies. Goal configurations are tried in turn, and again
with other random numbers once all have failed, until a motion is accepted.
"""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Floats

from .description import FRAME, describe
from .found import Clock, PeerResult
from .processes import start_solver
from .sampled import compute_finite_limits
from .tasks import PeerProblem, find_exact_start, sample_goals

_ENDS = 20  # configurations at the goal
_SHARE = 0.3  # of the time that is left, for one of them
_SETTINGS = {
    "tolerance": 1e-5,  # of the closure, [m] and [rad]
    "step": 0.1,  # [rad] of a projected path
    "shortcuts": 20,  # rounds
    "optimizing": 5.0,  # [s] at most
    "spacing": 0.1,  # [rad] between waypoints
}


def plan_by_constraint_graph(
    own: PeerProblem,
    problem: TrajectoryProblem,
    seed: int,
    clock: Clock,
    accept: Callable[[Floats], bool],
) -> PeerResult:
    """Plan with HPP; see `found.Peer`."""
    package = find_spec("pyhpp")
    libraries = None if package is None or package.origin is None else Path(package.origin)
    ask_solver = start_solver("HPP", "hpp_solver", libraries and str(libraries.parents[3]))
    goals = sample_goals(problem, np.random.default_rng([seed, 1]), _ENDS)
    if not len(goals):
        return PeerResult(status="no configuration at the goal")
    held = problem.is_closed(problem.task.phases[0])
    lower, upper = compute_finite_limits(problem)
    found = PeerResult(status="no path")
    with tempfile.TemporaryDirectory() as folder:
        files = describe(problem, Path(folder), by_body=True)
        ask = {
            "urdf": str(files.urdf),
            "srdf": str(files.srdf),
            "frame": FRAME,
            "joints": files.joints,
            "start": find_exact_start(problem).tolist(),
            "lower": lower.tolist(),
            "upper": upper.tolist(),
            "weights": problem.chain.metric.tolist(),
            "target": problem.targets[0].homogeneous.tolist() if held else None,
            "margins": [[*pair, margin] for pair, margin in files.margins.items()],
            **_SETTINGS,
        }
        for number, goal in enumerate(itertools.cycle(goals)):
            if clock.remaining <= 0.0:
                found.status = "timed out"
                break
            ask |= {"goal": goal.tolist(), "seed": 1000 * seed + number}
            answer = ask_solver({**ask, "time": max(1.0, _SHARE * clock.remaining)})
            clock.elsewhere += answer["cpu"]
            found.own += answer.get("own", 0.0)
            if "error" in answer:
                found.about["said"] = answer["error"]
                continue
            if found.first is None:
                found.first = clock.cpu_time - answer["optimizing"]
            found.path = np.array(answer["z"])
            found.status = "found"
            found.path[0] = problem.start
            if accept(found.path):
                break
    return found
