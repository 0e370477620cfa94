"""How to plan: what `plan` and `plan_chore` are asked for beside scene and steps, checked."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeGuard

import numpy as np

from vkc_pin.cache import Cache
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.interrupt import Interrupt
from vkc_pin.options import Options
from vkc_pin.planning.progress import Progress
from vkc_pin.scene.scene import Scene
from vkc_pin.seeds.initialization import INITIALIZATIONS
from vkc_pin.solver.solution import Iteration
from vkc_pin.task.terms import Term, traced

__all__ = ["Settings", "check_arguments", "settings_for"]


@dataclass(frozen=True)
class Settings:
    """How to plan; see `planner.plan`.

    Attributes:
        progress: Is told what is being done.
        interrupt: Whether Ctrl-C was pressed; then nothing new is begun. Copies for parts of a task share it.
        cache: What was built before; they share that, too.
    """

    initialization: str
    options: Options
    callback: Callable[[Iteration], None] | None = None
    time_limit: float | None = None
    random_seed: int = 0
    perturbation: float = 0.0
    terms: tuple[Term, ...] = ()
    progress: Progress = field(default_factory=Progress)
    interrupt: Interrupt = field(default_factory=Interrupt)
    cache: Cache = field(default_factory=Cache)

    def after(self, spent: Iterable[Mapping[str, float]]) -> Settings:
        """Return the settings with what problems that were planned, by their metrics, have left of the time limit."""
        if self.time_limit is None:
            return self
        used = sum(metrics["planning_time"] for metrics in spent)
        return replace(self, time_limit=max(self.time_limit - used, 1e-3))


def settings_for(
    scene: Scene,
    *,
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
    for name, value, kind in (("scene", scene, Scene), ("options", options, Options)):
        if not isinstance(value, kind):
            raise InputError("wrong kind of argument", field=name, expected=f"a {kind.__name__}", got=repr(value))
    if time_limit is not None and not (_is_number(time_limit) and 0 < time_limit < np.inf):
        raise InputError("out of range", field="time_limit", expected="seconds, more than 0", got=repr(time_limit))
    if not isinstance(seed, int | np.integer) or isinstance(seed, bool) or seed < 0:
        raise InputError("out of range", field="seed", expected="a whole number of at least 0", got=repr(seed))


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
