"""plan(): from steps to a checked motion; and a `Planner`, which keeps what can be used again."""

from __future__ import annotations

import contextlib
import dataclasses
import threading
from collections.abc import Callable, Iterator, Sequence

from vkc_pin.options import Options
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.progress import shown
from vkc_pin.planning.settings import Settings, settings_for
from vkc_pin.planning.solver.solution import Iteration
from vkc_pin.planning.stepwise import all_at_once, step_by_step
from vkc_pin.utils.arguments import flag, instance, number, whole
from vkc_pin.utils.cache import Cache, CacheInfo
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.phases import summarize_phases
from vkc_pin.world.task.steps import Step
from vkc_pin.world.task.terms import Term, check_terms_active

__all__ = ["Planner", "borrowed", "guarded", "plan"]


class Planner:
    """Keeps what planning builds and can use again: symbolic programs with their solvers, kinematics, tables of shapes.

    Pass one as `planner=` to keep apart what different parts of a program build, or to bound it;
    without one, all calls share the process's own. It makes no difference to a motion what a
    planner has kept. Threads may plan with one planner at once: each plan borrows a cache of its
    own, and at the end leaves it to the next.

    Args:
        entries: How many objects are kept at most.
        megabytes: How much memory they take at most, as estimated [MB]. While plans run they may
            take more.
    """

    def __init__(self, *, entries: int = 512, megabytes: float = 128.0) -> None:
        self.entries = whole(entries, "entries", low=1)
        self.megabytes = number(megabytes, "megabytes", "more than 0", low=0.0, above=True)
        self._idle: list[Cache] = []
        self._lock = threading.Lock()

    def __repr__(self) -> str:
        info = self.info()
        return f"<Planner: {info.entries} of {self.entries} entries, {info.nbytes / 1e6:.1f} of {self.megabytes:g} MB>"

    def info(self) -> CacheInfo:
        """Return how much is kept, and how often something was there when it was asked for; not of plans that are running."""
        with self._lock:
            return self._total()

    def _total(self) -> CacheInfo:
        every = [dataclasses.astuple(cache.info()) for cache in self._idle]
        return CacheInfo(*(sum(column) for column in zip(*every, strict=True)))

    def clear(self) -> None:
        """Forget all that is kept; plans that are running go on with what they have."""
        with self._lock:
            self._idle.clear()

    @contextlib.contextmanager
    def lent(self) -> Iterator[Cache]:
        """Lend a cache that nobody else has, the one that was used last if it is free; at the end make room."""
        with self._lock:
            cache = (
                self._idle.pop()
                if self._idle
                else Cache(entries=self.entries, nbytes=1e6 * self.megabytes)
            )
        try:
            yield cache
        finally:
            cache.trim()
            with self._lock:
                self._idle.append(cache)
                while len(self._idle) > 1:  # those go first that were used longest ago
                    total = self._total()
                    if total.entries <= self.entries and total.nbytes <= 1e6 * self.megabytes:
                        break
                    del self._idle[0]


_shared = Planner()


def borrowed(planner: Planner | None) -> contextlib.AbstractContextManager[Cache]:
    """Return what lends a cache of a planner, or of the process's own if there is none; see `Planner.lent`."""
    return (_shared if planner is None else instance(planner, Planner, "planner")).lent()


def plan(
    scene: Scene,
    steps: Sequence[Step],
    *,
    initialization: str = "auto",
    options: Options | None = None,
    callback: Callable[[Iteration], None] | None = None,
    time_limit: float | None = None,
    effort: int | None = None,
    seed: int = 0,
    joint: bool = True,
    perturbation: float = 0.0,
    progress: bool = False,
    terms: Sequence[Term] = (),
    planner: Planner | None = None,
) -> Plan:
    """Plan one coordinated motion of base, arm and objects that brings about `steps`.

    Args:
        scene: Robot, objects and obstacles; the motion starts at the scene's start.
        steps: What should change in the world, in this order: `Reach`, `Grasp`, `Actuate`, `Touch`,
            `Place`, `Release`, `GoTo`.
        initialization: "auto", "interpolated", "astar", "rrt" or "stationary"; see
            `initialization.initialize`.
        options: How to plan; `Options()` if left out.
        callback: Called after every round of the solver with an `Iteration`, whose fields are named
            columns.
        time_limit: Seconds by the clock, from the call on and with all that is built and checked,
            after which the best motion so far is returned, with status "time limit". What succeeds
            within it depends on the machine and on what else runs there.
        effort: The same as a count of work, with status "effort spent": how many configurations may
            be looked at, by searches for seeds, and in every iteration of Ipopt at each waypoint.
            The same call succeeds with it on every machine, or fails. What a plan took is in
            `metrics["effort"]`; 100 000 take some ten seconds.
        seed: Of the random numbers. The same call gives the same trajectory on the same machine,
            bit for bit, whatever was planned before; only `time_limit` can make a difference.
        joint: Plan all steps as one problem; otherwise each from where the one before it ends, for
            comparison.
        perturbation: Standard deviation of smooth noise on the seeds, [m] and [rad], to see how
            much hangs on them.
        progress: Show one line that changes in its place: in a notebook or a terminal; elsewhere
            nothing is shown.
        terms: Own constraints and costs, beside those of every motion; see `Constraint` and `Cost`.
        planner: Keeps what can be used again; None: the process's own.

    Returns:
        A plan, in every case: `plan.success` is true only if the independent `validation` found
            nothing wrong, and
        `plan.report()` names what is violated otherwise. Ctrl-C, or interrupting a notebook's
        kernel, ends planning with the best iterate so far and status "interrupted"; a second Ctrl-C
        raises KeyboardInterrupt.

    Raises:
        InputError: The steps or terms name something that is not there or cannot be done, or an
            argument is wrong.
    """
    settings = settings_for(
        scene,
        initialization=initialization,
        options=options,
        callback=callback,
        time_limit=time_limit,
        effort=effort,
        seed=seed,
        perturbation=perturbation,
        terms=terms,
    )

    joint = flag(joint, "joint")

    def run(settings: Settings) -> Plan:
        task = compile_task(scene, steps, settings.options)
        ready = scene.with_approaches(
            (hold for hold in task.holds if hold.by is not None), stacklevel=5
        )
        task = task if ready is scene else compile_task(ready, steps, settings.options)
        check_terms_active(settings.terms, summarize_phases(task))
        return all_at_once(ready, task, settings) if joint else step_by_step(ready, task, settings)

    return guarded(run, settings, progress, planner)


def guarded(
    run: Callable[[Settings], Plan],
    settings: Settings,
    progress: bool,
    planner: Planner | None = None,
) -> Plan:
    """Return what `run` returns, whose settings' budget runs, and which is lent a cache; show its progress."""
    with borrowed(planner) as cache, shown(progress) as line, settings.budget.running():
        found = run(dataclasses.replace(settings, progress=line, cache=cache))
        line.end(found)
    return found
