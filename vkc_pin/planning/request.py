"""Checks the arguments of planning and holds them in one immutable request."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from vkc_pin.errors import InputError, format_value
from vkc_pin.options import Options
from vkc_pin.planning.initialization.methods import INITIALIZATIONS
from vkc_pin.planning.plan import Plan, PlanningStatistics
from vkc_pin.planning.progress import Progress
from vkc_pin.planning.solver.solution import Iteration
from vkc_pin.utils.arguments import (
    check_choice,
    check_instance,
    check_integer,
    check_number,
    is_number,
)
from vkc_pin.utils.budget import Budget
from vkc_pin.utils.cache import Cache
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.terms import Term
from vkc_pin.world.trajectory.trajectory import Trajectory

DEFAULT_TIME_LIMIT = 60.0
"""Wall-clock limit of a planning call that gives no limit [s]."""

MAX_PERTURBATION = 3.0
"""Largest standard deviation of noise on initial guesses, [m] and [rad]."""


@dataclass
class SearchLog:
    """What all searches of a planning call have done so far.

    Attributes:
        statistics: Sum of their times and counts, and of those of validating joined plans.
        history: One row per round of the solver, in all of them.
    """

    statistics: PlanningStatistics = field(default_factory=PlanningStatistics)
    history: list[Mapping[str, float]] = field(default_factory=list)

    def add(self, statistics: PlanningStatistics) -> None:
        """Add times and counts."""
        self.statistics += statistics


@dataclass(frozen=True)
class PlanningRequest:
    """Checked arguments of one planning call; see `plan`.

    Attributes:
        guess: Motion from which the search starts, if any.
        explains: Whether a failure has the best motion that was found, validated, and notes on its
            causes; else it has a motion that stands still. To find causes may take seconds.
        wants_draft: Whether a converged solution is returned as a `Draft`.
        check_factor: Factor of the collision checks of searches with trees; see `plan`.
        is_tentative: Whether planning gives up if the goals of its first initial guess seem to be
            blocked, as steps before can be planned again with another grasp.
        log: Statistics and history of the call's searches; requests derived from this one share it.
    """

    initialization: str
    options: Options
    callback: Callable[[Iteration], None] | None = None
    random_seed: int = 0
    perturbation: float = 0.0
    terms: tuple[Term, ...] = ()
    progress: Progress = field(default_factory=Progress)
    cache: Cache = field(default_factory=Cache)
    check_factor: int = 1
    guess: Trajectory | None = None
    explains: bool = True
    wants_draft: bool = False
    is_tentative: bool = False
    log: SearchLog = field(default_factory=SearchLog)


def make_request(
    scene: Scene,
    *,
    initialization: str,
    options: Options,
    callback: Callable[[Iteration], None] | None,
    seed: int,
    perturbation: float = 0.0,
    guess: object = None,
    terms: tuple[Term, ...] = (),
) -> PlanningRequest:
    """Return the arguments of `plan` as a request. Raises `InputError` for invalid ones."""
    check_arguments(scene, options, seed)
    check_choice(initialization, INITIALIZATIONS, "initialization", "initialization")
    noise = check_number(perturbation, "perturbation", "a number of at least 0", low=0.0)
    if noise > MAX_PERTURBATION:
        expected = f"at most {MAX_PERTURBATION:g}"
        raise InputError("out of range", field="perturbation", expected=expected, got=noise)
    if callback is not None and not callable(callback):
        expected, got = "a function of an Iteration", format_value(callback)
        raise InputError("cannot be called", field="callback", expected=expected, got=got)
    return PlanningRequest(
        initialization, options, callback, int(seed), noise, terms, guess=_get_motion(guess)
    )


def _get_motion(guess: object) -> Trajectory | None:
    """Return the motion of an initial guess. Raises `InputError`."""
    if isinstance(guess, Plan):
        return guess.trajectory
    if guess is None or isinstance(guess, Trajectory):
        return guess
    expected = "a Plan or a Trajectory"
    raise InputError("wrong type", field="guess", expected=expected, got=format_value(guess))


def make_budget(time_limit: object, max_evaluations: object) -> Budget:
    """Return the budget of a planning call, which starts now. Raises `InputError`.

    Without any limit, it is `DEFAULT_TIME_LIMIT`.
    """
    if max_evaluations is not None:
        max_evaluations = check_integer(max_evaluations, "max_evaluations", low=1)
    if time_limit is None:
        time_limit = DEFAULT_TIME_LIMIT if max_evaluations is None else math.inf
    expected = "a time [s], more than 0; inf: no limit"
    if is_number(time_limit) and time_limit == math.inf:
        return Budget(None, max_evaluations)
    seconds = check_number(time_limit, "time_limit", expected, low=0.0, strict=True)
    return Budget(seconds, max_evaluations)


def check_arguments(scene: object, options: object, seed: object) -> None:
    """Check the types of a scene, options and a random seed. Raises `InputError`."""
    for name, value, kind in (("scene", scene, Scene), ("options", options, Options)):
        check_instance(value, kind, name)
    check_integer(seed, "seed", low=0)
