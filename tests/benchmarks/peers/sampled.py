"""Plans with OMPL: RRT-Connect, on an atlas of the closure manifold if something is grasped.

`ProjectedStateSpace` found no path: its samples are mostly off the manifold. Kinematics, distances
and goal configurations are those of this package, scaled by the chain's metric. Unconstrained
motions are checked in batches, since calls from C++ to Python are expensive.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.optional_imports import import_optional

from .found import Clock, PeerResult
from .tasks import PeerProblem, find_exact_start, sample_goals

_ENDS = 20  # configurations at the goal
_STEP = 0.05  # [rad] between configurations that are looked at
_RANGE = 1.0  # [rad] that a tree grows at most at a time
_TOLERANCE = 1e-5  # of the manifold, [m] and [rad]
_SIMPLIFYING = 10.0  # [s] at most
_TURN = 2.0 * np.pi  # [rad] range of a joint without limits, on both sides of the start


def compute_finite_limits(problem: TrajectoryProblem) -> tuple[Floats, Floats]:
    """Return finite limits of the coordinates, shape (n,) each."""
    lower = np.minimum(problem.lower.min(axis=0), problem.start)
    upper = np.maximum(problem.upper.max(axis=0), problem.start)
    return np.maximum(lower, problem.start - _TURN - 20.0 * np.isfinite(lower)), np.minimum(
        upper, problem.start + _TURN + 20.0 * np.isfinite(upper)
    )


def plan_by_sampling(  # noqa: C901, PLR0915 - sets up one planner, step by step
    own: PeerProblem,
    problem: TrajectoryProblem,
    seed: int,
    clock: Clock,
    accept: Callable[[Floats], bool],
) -> PeerResult:
    """Plan with OMPL; see `found.Peer`."""
    ob, og, ou = (
        import_optional(f"ompl.{part}", "peers", purpose="comparing planners")
        for part in ("base", "geometric", "util")
    )
    ou.setLogLevel(ou.LogLevel.LOG_NONE)
    ou.RNG.setSeed(seed + 1)
    goals = sample_goals(problem, np.random.default_rng([seed, 1]), _ENDS)
    if not len(goals):
        return PeerResult(status="no configuration at the goal")
    scale = problem.chain.metric
    held = problem.is_closed(problem.task.phases[0])
    size = problem.chain.size
    middle = 1
    lower, upper = compute_finite_limits(problem)
    space = ob.RealVectorStateSpace(size)
    bounds = ob.RealVectorBounds(size)
    for k in range(size):
        bounds.setLow(k, float(lower[k] * scale[k] - 1e-6))
        bounds.setHigh(k, float(upper[k] * scale[k] + 1e-6))
    space.setBounds(bounds)

    def blocked(z: Floats) -> int:
        whole = np.array([0, len(z)])
        reach = problem.options.largest_margin
        return int(problem.contacts.count_free(z, whole, middle, reach=reach, allowed=0.0)[0])

    def values(state: Any) -> Floats:
        return np.array([state[k] for k in range(size)]) / scale

    if held:
        solver = problem.pose_solvers[0]
        target = problem.targets[0]

        class Closure(ob.Constraint):  # type: ignore[name-defined]
            def __init__(self) -> None:
                super().__init__(size, solver.rows, _TOLERANCE)

            def function(self, x: Floats, out: Floats) -> None:
                out[:] = solver.evaluate(np.asarray(x)[None] / scale, target)[0][0]

            def jacobian(self, x: Floats, out: Floats) -> None:
                out[:] = solver.evaluate(np.asarray(x)[None] / scale, target)[1][0] / scale

        constraint = Closure()
        used = ob.AtlasStateSpace(space, constraint)
        information = ob.ConstrainedSpaceInformation(used)
        used.setDelta(_STEP)
    else:
        used = space
        information = ob.SpaceInformation(space)
    information.setStateValidityChecker(lambda state: bool(blocked(values(state)[None]) == 1))
    if not held:

        class Motions(ob.MotionValidator):  # type: ignore[name-defined]
            def checkMotion(self, one: Any, other: Any) -> bool:
                a = values(one)
                b = values(other)
                count = max(1, int(np.ceil(np.abs((b - a) * scale).max() / _STEP)))
                z = a + (np.arange(1, count + 1) / count)[:, None] * (b - a)
                return bool(blocked(z) == len(z))

        motions = Motions(information)
        information.setMotionValidator(motions)

    def make_state(z: Floats) -> Any:
        state = information.allocState()
        scaled = [float(value) for value in z * scale]
        if held:
            state.copy(scaled)
        else:
            for k, value in enumerate(scaled):
                state[k] = value
        return state

    if held:
        information.setup()
    start = make_state(find_exact_start(problem))
    states = [make_state(row) for row in goals]
    if held:
        for state in (start, *states):
            used.anchorChart(state)
    setup = og.SimpleSetup(information)
    setup.setStartState(start)
    region = ob.GoalStates(information)
    for state in states:
        region.addState(state)
    setup.setGoal(region)
    planner = og.RRTConnect(information)
    planner.setRange(_RANGE)
    setup.setPlanner(planner)
    setup.setup()
    began = time.process_time()
    setup.solve(float(max(clock.remaining - _SIMPLIFYING, 1.0)))
    found = PeerResult(own=time.process_time() - began, status="timed out")
    if not setup.haveExactSolutionPath():
        return found
    path = setup.getSolutionPath()
    found.first = clock.cpu_time
    simplifier = og.PathSimplifier(information)
    began = time.process_time()
    simplifier.simplify(path, _SIMPLIFYING)
    found.own += time.process_time() - began
    if held:
        path.interpolate()
    rows = np.array([values(path.getState(k)) for k in range(path.getStateCount())])
    rows[0] = problem.start
    found.path = subdivide(rows, scale)
    found.status = "found"
    return found


def subdivide(rows: Floats, scale: Floats, step: float = 0.2) -> Floats:
    """Insert waypoints so that none are more than `step` [rad] apart."""
    parts = [rows[:1]]
    for a, b in itertools.pairwise(rows):
        far = np.abs((b - a) * scale).max()
        if far < 1e-9:
            continue
        count = max(1, int(np.ceil(far / step)))
        parts.append(a + (np.arange(1, count + 1) / count)[:, None] * (b - a))
    return np.concatenate(parts)
