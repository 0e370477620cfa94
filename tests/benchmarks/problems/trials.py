"""Plans problems and records statistics."""

from __future__ import annotations

import functools
import time
from typing import Any

import numpy as np

from vkc_pin.experiments.harness.record import trial
from vkc_pin.experiments.harness.runner import LIMITS
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.planner import Planner, acquire_cache
from vkc_pin.planning.prepare import plan
from vkc_pin.planning.solver.solution import Iteration
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.steps import Reach, Step

from .changes import UNCHANGED, Change


def run_trial(
    scene: Scene, steps: tuple[Step, ...], *, seed: int, change: Change = UNCHANGED, **more: Any
) -> dict[str, Any]:
    """Plan a problem and return its record with times, solves and objective."""
    _warm()
    solves: list[int] = []

    def count(row: Iteration) -> None:
        solves.extend([row.round] if row.round == 1 else [])

    planner = _planner(change)
    # Before the clock starts: looking for where a constant is imported takes a while
    with change.apply():
        wall = time.perf_counter()
        cpu = time.process_time()
        found = plan(
            scene,
            steps,
            options=change.options,
            seed=seed,
            callback=count,
            planner=planner,
            **LIMITS,
        )
        took = {"wall_time": time.perf_counter() - wall, "cpu_time": time.process_time() - cpu}
    own: dict[str, Any] = {
        **took,
        "solves": len(solves),
        "first_seed": is_first_guess_success(found, len(solves)),
        "objective": compute_objective(found, planner),
        "duration": found.metrics["duration"],
    }
    return trial(found, method=str(change), seed=seed, **own, **more)


def is_first_guess_success(found: Plan, solves: int) -> bool:
    """Return whether a plan succeeded with the first initial guess of each of its programs.

    Several steps are solved one by one, then all at once: `Plan.initialization` names each program.

    Args:
        found: The plan.
        solves: How often the solver ran.
    """
    return found.success and solves == len(found.initialization.split(", "))


def compute_objective(found: Plan, planner: Planner | None = None) -> float | None:
    """Return the objective of a successful plan that is one problem, without grasp freedoms.

    Freedoms of grasps have other values in the program while nothing is grasped.
    """
    if not found.success:
        return None
    task = compile_task(found.scene, found.steps, found.options)
    spans = found.trajectory.phases
    if [span.name for span in spans][: len(task.phases)] != [phase.name for phase in task.phases]:
        return None  # motions of single steps, one after the other
    with acquire_cache(planner) as cache:
        problem = TrajectoryProblem(found.scene, task, found.options, (), cache=cache)
        # Pauses for the gripper, at the beginning of a phase, are no waypoints of the program.
        rows = np.concatenate(
            [
                np.arange(span.last - phase.segments, span.last) + 1
                for span, phase in zip(spans, task.phases, strict=False)
            ]
        )
        if problem.chain.names != found.trajectory.names:
            return None
        freedoms = {name for names in problem.chain.virtual.values() for name in names}
        counted = np.array([name not in freedoms for name in problem.chain.names])
        dt = np.full(problem.segments, problem.options.dt)
        first, second = problem.rates(found.trajectory.positions[rows], dt)
        return problem.motion_cost.value(first * counted, second * counted)


@functools.cache
def _planner(change: Change) -> Planner:
    """Return the planner of a change, whose caches hold its own constants."""
    return Planner()


@functools.cache
def _warm() -> None:
    """Plan once in this process, which includes loading."""
    scene = load_scene("drawer")
    if plan(scene, [Reach(scene.tool_placement())], planner=Planner()).status == "interrupted":
        raise KeyboardInterrupt
