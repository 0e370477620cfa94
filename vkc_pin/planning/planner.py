"""plan(): from steps to a checked motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

from vkc_pin.interrupt import interruptible
from vkc_pin.options import Options
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.progress import shown
from vkc_pin.planning.settings import Settings, settings_for
from vkc_pin.planning.stepwise import all_at_once, step_by_step
from vkc_pin.scene.scene import Scene
from vkc_pin.solver.solution import Iteration
from vkc_pin.task.compiler import compile_task
from vkc_pin.task.phases import stretches
from vkc_pin.task.steps import Step
from vkc_pin.task.terms import Term, check_active

__all__ = ["guarded", "plan"]


def plan(
    scene: Scene,
    steps: Sequence[Step],
    *,
    initialization: str = "auto",
    options: Options | None = None,
    callback: Callable[[Iteration], None] | None = None,
    time_limit: float | None = None,
    seed: int = 0,
    joint: bool = True,
    perturbation: float = 0.0,
    progress: bool = False,
    terms: Sequence[Term] = (),
) -> Plan:
    """Plan one coordinated motion of base, arm and objects that brings about `steps`.

    Args:
        scene: Robot, objects and obstacles; the motion starts at the scene's start.
        steps: What should change in the world, in this order: `Reach`, `Grasp`, `Actuate`, `Touch`, `Place`, `Release`, `GoTo`.
        initialization: "auto", "interpolated", "astar", "rrt" or "stationary"; see `initialization.initialize`.
        options: How to plan; `Options()` if left out.
        callback: Called after every round of the solver with an `Iteration`, whose fields are named columns.
        time_limit: Seconds of planning after which the best iterate is returned, with status "time limit".
        seed: Of the random numbers. The same calls in a new process give the same trajectory on the same machine; what was
            planned before in a process can change the last digits.
        joint: Plan all steps as one problem; otherwise each from where the one before it ends, for comparison.
        perturbation: Standard deviation of smooth noise on the seeds, [m] and [rad], to see how much hangs on them.
        progress: Show one line that changes in its place: in a notebook or a terminal; elsewhere nothing is shown.
        terms: Own constraints and costs, beside those of every motion; see `Constraint` and `Cost`.

    Returns:
        A plan, in every case: `plan.success` is true only if the independent `validation` found nothing wrong, and
        `plan.report()` names what is violated otherwise. Ctrl-C, or interrupting a notebook's kernel, ends planning with the best
        iterate so far and status "interrupted"; a second Ctrl-C raises KeyboardInterrupt.

    Raises:
        InputError: The steps or terms name something that is not there or cannot be done, or an argument is wrong.
    """
    settings = settings_for(
        scene,
        initialization=initialization,
        options=options,
        callback=callback,
        time_limit=time_limit,
        seed=seed,
        perturbation=perturbation,
        terms=terms,
    )

    def planner(settings: Settings) -> Plan:
        task = compile_task(scene, steps, settings.options)
        check_active(settings.terms, stretches(task))
        return all_at_once(scene, task, settings) if joint else step_by_step(scene, task, settings)

    return guarded(planner, settings, progress)


def guarded(planner: Callable[[Settings], Plan], settings: Settings, progress: bool) -> Plan:
    """Return what a planner returns that is told of Ctrl-C by its settings; show its progress."""
    with shown(progress) as line, interruptible(settings.interrupt):
        found = planner(dataclasses.replace(settings, progress=line))
        line.end(found)
    return found
