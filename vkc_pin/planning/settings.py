"""How to plan: what `plan` and `plan_chore` are asked for beside scene and steps, checked."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeGuard

import numpy as np

from vkc_pin.budget import Budget
from vkc_pin.cache import Cache
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.options import Options
from vkc_pin.planning.progress import Progress
from vkc_pin.scene.scene import Scene
from vkc_pin.seeds.initialization import INITIALIZATIONS
from vkc_pin.solver.solution import Iteration
from vkc_pin.task.terms import Term, traced

__all__ = ["Settings", "budget_for", "check_arguments", "settings_for"]


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
    if initialization not in INITIALIZATIONS:
        raise UnknownNameError("initialization", str(initialization), INITIALIZATIONS, field="initialization")
    if not (_is_number(perturbation) and 0 <= perturbation < np.inf):
        raise InputError("out of range", field="perturbation", expected="a number of at least 0", got=repr(perturbation))
    return Settings(initialization, options, callback, int(seed), float(perturbation), traced(scene, terms), budget=budget)


def budget_for(time_limit: object, effort: object) -> Budget:
    """Return the budget of a call, which runs from now on; see `plan`.

    Raises:
        InputError: One of these is wrong.
    """
    if time_limit is not None and not (_is_number(time_limit) and 0 < time_limit < np.inf):
        raise InputError("out of range", field="time_limit", expected="seconds, more than 0", got=repr(time_limit))
    if effort is not None and not (isinstance(effort, int | np.integer) and not isinstance(effort, bool) and effort > 0):
        raise InputError("out of range", field="effort", expected="a whole number of at least 1", got=repr(effort))
    return Budget(None if time_limit is None else float(time_limit), None if effort is None else int(effort))


def check_arguments(scene: object, options: object, seed: object) -> None:
    """Raise an InputError that says what is wrong if one of these is not what planning needs; see `plan`."""
    for name, value, kind in (("scene", scene, Scene), ("options", options, Options)):
        if not isinstance(value, kind):
            raise InputError("wrong kind of argument", field=name, expected=f"a {kind.__name__}", got=repr(value))
    if not isinstance(seed, int | np.integer) or isinstance(seed, bool) or seed < 0:
        raise InputError("out of range", field="seed", expected="a whole number of at least 0", got=repr(seed))


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
