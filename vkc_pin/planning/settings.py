"""How to plan: what `plan` and `plan_chore` are asked for beside scene and steps, checked."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from vkc_pin.errors import InputError, shown
from vkc_pin.options import Options
from vkc_pin.planning.initialization.methods import INITIALIZATIONS
from vkc_pin.planning.progress import Progress
from vkc_pin.planning.solver.solution import Iteration
from vkc_pin.utils.arguments import instance, known, number, whole
from vkc_pin.utils.budget import Budget
from vkc_pin.utils.cache import Cache
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.terms import Term, trace_terms

__all__ = ["Settings", "budget_for", "check_arguments", "settings_for"]

LARGEST_NOISE = 3.0  # [m] and [rad]: seeds with more are further apart than rooms are wide


@dataclass(frozen=True)
class Settings:
    """How to plan; see `planner.plan`.

    Attributes:
        progress: Is told what is being done.
        budget: What all of it may take; copies for parts of a task share it.
        cache: What was built before; they share that, too.
    """

    initialization: str
    options: Options
    callback: Callable[[Iteration], None] | None = None
    random_seed: int = 0
    perturbation: float = 0.0
    terms: tuple[Term, ...] = ()
    progress: Progress = field(default_factory=Progress)
    budget: Budget = field(default_factory=Budget)
    cache: Cache = field(default_factory=Cache)


def settings_for(
    scene: Scene,
    *,
    initialization: str,
    options: Options | None,
    callback: Callable[[Iteration], None] | None,
    time_limit: float | None,
    effort: int | None,
    seed: int,
    perturbation: float = 0.0,
    terms: Sequence[Term] = (),
) -> Settings:
    """Return arguments of `plan` as settings, whose budget runs from now on.

    Raises:
        InputError: One of them is wrong.
    """
    options = Options() if options is None else options
    budget = budget_for(time_limit, effort)
    check_arguments(scene, options, seed)
    known(initialization, INITIALIZATIONS, "initialization", "initialization")
    if (
        noise := number(perturbation, "perturbation", "a number of at least 0", low=0.0)
    ) > LARGEST_NOISE:
        raise InputError(
            "out of range", field="perturbation", expected=f"at most {LARGEST_NOISE:g}", got=noise
        )
    if callback is not None and not callable(callback):
        raise InputError(
            "cannot be called",
            field="callback",
            expected="a function of an Iteration",
            got=shown(callback),
        )
    return Settings(
        initialization,
        options,
        callback,
        int(seed),
        noise,
        trace_terms(scene, terms),
        budget=budget,
    )


def budget_for(time_limit: object, effort: object) -> Budget:
    """Return the budget of a call, which runs from now on; see `plan`.

    Raises:
        InputError: One of these is wrong.
    """
    if time_limit is not None:
        time_limit = number(time_limit, "time_limit", "seconds, more than 0", low=0.0, above=True)
    return Budget(time_limit, None if effort is None else whole(effort, "effort", low=1))


def check_arguments(scene: object, options: object, seed: object) -> None:
    """Raise an InputError that says what is wrong if one of these is not what planning needs; see `plan`."""
    for name, value, kind in (("scene", scene, Scene), ("options", options, Options)):
        instance(value, kind, name)
    whole(seed, "seed", low=0)
