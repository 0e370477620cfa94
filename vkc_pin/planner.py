"""plan(): from steps to a checked motion."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import TypeGuard

import numpy as np

from vkc_pin.all_at_once import all_at_once
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.goal import compile_task
from vkc_pin.initialization import INITIALIZATIONS
from vkc_pin.one_problem import Settings
from vkc_pin.options import Options
from vkc_pin.plan import Plan
from vkc_pin.progress import shown
from vkc_pin.scene import Scene
from vkc_pin.solution import Iteration
from vkc_pin.standing import standing
from vkc_pin.step_by_step import step_by_step
from vkc_pin.steps import Step
from vkc_pin.term_goals import stretches
from vkc_pin.terms import Term, check_active, traced

__all__ = ["check_arguments", "guarded", "plan", "settings_for"]


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
        iterate so far and status "interrupted".

    Raises:
        InputError: The steps or terms name something that is not there or cannot be done, or an argument is wrong.
    """
    settings = settings_for(scene, initialization, options, callback, time_limit, seed, perturbation, terms)
    if settings.terms:
        check_active(settings.terms, stretches(compile_task(scene, steps, settings.options)))
    return guarded(step_by_step if not joint else all_at_once, scene, steps, settings, progress)


def guarded(
    planner: Callable[[Scene, Sequence[Step], Settings], Plan],
    scene: Scene,
    steps: Sequence[Step],
    settings: Settings,
    progress: bool,
) -> Plan:
    """Return what a planner returns, or a plan in which nothing moves if Ctrl-C comes before it has any; show its progress."""
    with shown(progress) as line:
        began, settings = time.perf_counter(), dataclasses.replace(settings, progress=line)
        try:
            found = planner(scene, steps, settings)
        except KeyboardInterrupt:
            spent = time.perf_counter() - began
            found = standing(scene, list(steps), settings.options, seed=settings.seed, spent=spent, terms=settings.terms)
        line.end(found)
    return found


def settings_for(
    scene: Scene,
    initialization: str,
    options: Options | None,
    callback: Callable[[Iteration], None] | None,
    time_limit: float | None,
    seed: int,
    perturbation: float = 0.0,
    terms: Sequence[Term] = (),
) -> Settings:
    """Return arguments of `plan` as settings.

    Raises:
        InputError: One of them is wrong.
    """
    options = Options() if options is None else options
    check_arguments(scene, options, time_limit, seed)
    if initialization not in INITIALIZATIONS:
        raise UnknownNameError("initialization", str(initialization), INITIALIZATIONS, field="initialization")
    if not (_is_number(perturbation) and 0 <= perturbation < np.inf):
        raise InputError("out of range", field="perturbation", expected="a number of at least 0", got=repr(perturbation))
    return Settings(initialization, options, callback, time_limit, int(seed), float(perturbation), traced(scene, terms))


def check_arguments(scene: object, options: object, time_limit: object, seed: object) -> None:
    """Raise an InputError that says what is wrong if one of these is not what planning needs; see `plan`."""
    for field, value, kind in (("scene", scene, Scene), ("options", options, Options)):
        if not isinstance(value, kind):
            raise InputError("wrong kind of argument", field=field, expected=f"a {kind.__name__}", got=repr(value))
    if time_limit is not None and not (_is_number(time_limit) and 0 < time_limit < np.inf):
        raise InputError("out of range", field="time_limit", expected="seconds, more than 0", got=repr(time_limit))
    if not isinstance(seed, int | np.integer) or isinstance(seed, bool) or seed < 0:
        raise InputError("out of range", field="seed", expected="a whole number of at least 0", got=repr(seed))


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
