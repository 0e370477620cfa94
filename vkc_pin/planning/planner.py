"""Plans the trajectory of steps, with the entry point `plan` and the caches of a `Planner`."""

from __future__ import annotations

import contextlib
import dataclasses
import threading
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.planning.initialization.methods import Initialization
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.progress import show_progress
from vkc_pin.planning.request import PlanningRequest, make_budget, make_request
from vkc_pin.planning.results import FINAL, add_statistics
from vkc_pin.planning.sequential import (
    plan_sequentially,
    plan_simultaneously,
    solve_with_alternatives,
)
from vkc_pin.planning.solver.solution import Iteration
from vkc_pin.planning.window import plan_with_window
from vkc_pin.utils.arguments import check_bool, check_instance, check_integer, check_number
from vkc_pin.utils.budget import Budget
from vkc_pin.utils.cache import Cache, CacheInfo
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.actions import compile_each_step
from vkc_pin.world.task.actuation import find_shared_coordinate
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.loads import check_footings, check_loads
from vkc_pin.world.task.phases import Task, summarize_phases
from vkc_pin.world.task.steps import Step, as_steps
from vkc_pin.world.task.terms import Term, check_terms_active


class Planner:
    """Owns the caches of planning: symbolic programs with their solvers, kinematics, shape tables.

    Pass one as `planner=` to separate or to bound the caches of parts of a program; without one,
    all calls share the process's own. Cached values make no difference to a trajectory. Threads may
    plan with one planner at once: each call acquires a cache of its own and releases it at the end.

    Args:
        entries: Largest number of cached objects.
        megabytes: Largest memory of all caches, as estimated [MB]. Running calls may exceed it.
    """

    def __init__(self, *, entries: int = 512, megabytes: float = 128.0) -> None:
        self.entries = check_integer(entries, "entries", low=1)
        self.megabytes = check_number(megabytes, "megabytes", "more than 0", low=0.0, strict=True)
        self._idle: list[Cache] = []
        self._lock = threading.Lock()

    def __repr__(self) -> str:
        info = self.info()
        entries = f"{info.entries} of {self.entries} entries"
        return f"<Planner: {entries}, {info.nbytes / 1e6:.1f} of {self.megabytes:g} MB>"

    def info(self) -> CacheInfo:
        """Return entries, memory, hits and misses of all caches that no call uses at present."""
        with self._lock:
            return self._total()

    def _total(self) -> CacheInfo:
        every = [dataclasses.astuple(cache.info()) for cache in self._idle]
        return CacheInfo(*(sum(column) for column in zip(*every, strict=True)))

    def clear(self) -> None:
        """Evict everything; running calls keep their caches."""
        with self._lock:
            self._idle.clear()

    @contextlib.contextmanager
    def acquire(self) -> Iterator[Cache]:
        """Acquire a cache for exclusive use, the most recently used one; evict at the end."""
        with self._lock:
            new = (
                None
                if self._idle
                else Cache(max_entries=self.entries, max_nbytes=1e6 * self.megabytes)
            )
            cache = self._idle.pop() if new is None else new
        try:
            yield cache
        finally:
            cache.trim()
            with self._lock:
                self._idle.append(cache)
                while len(self._idle) > 1:  # the least recently used go first
                    total = self._total()
                    if total.entries <= self.entries and total.nbytes <= 1e6 * self.megabytes:
                        break
                    del self._idle[0]


_shared = Planner()


def acquire_cache(planner: Planner | None) -> contextlib.AbstractContextManager[Cache]:
    """Acquire a cache of a planner, or of the process's own; see `Planner.acquire`."""
    return (_shared if planner is None else check_instance(planner, Planner, "planner")).acquire()


def plan(  # noqa: PLR0913 - keyword options of a public call
    scene: Scene,
    steps: Sequence[Step],
    *,
    initialization: Initialization = "auto",
    options: Options | None = None,
    callback: Callable[[Iteration], None] | None = None,
    time_limit: float | None = None,
    max_evaluations: int | None = None,
    seed: int = 0,
    simultaneous: bool = True,
    window: int | None = None,
    perturbation: float = 0.0,
    progress: bool = False,
    terms: Sequence[Term] = (),
    planner: Planner | None = None,
) -> Plan:
    """Plan one coordinated trajectory of base, arm and objects that achieves `steps`.

    Args:
        scene: Robot, objects and obstacles; the trajectory starts at the scene's start.
        steps: What should change in the world, in this order: `Reach`, `Grasp`, `Actuate`, `Touch`,
            `Place`, `Release`, `GoTo`, `Configure`.
        initialization: Initialization method: "auto", "interpolated", "astar", "rrt" or
            "stationary". If all initial guesses of "auto" have failed, it goes on with fresh random
            numbers and longer searches until a limit, if there is one.
        options: Options of planning; `Options()` by default.
        callback: Called with an `Iteration` after every round of the solver.
        time_limit: Wall-clock limit of the call [s], after which the best trajectory so far is
            returned with status "time limit". Success then depends on the machine and its load.
            Default: 60 s, or none if `max_evaluations` is given; `math.inf`: none.
        max_evaluations: Limit on evaluated configurations, by searches for initial guesses and by
            every iteration of Ipopt at each waypoint; the status is then "evaluation limit". It
            does not depend on the speed or load of the machine. 100 000 evaluations take some ten
            seconds; `plan.statistics.evaluations` counts them.
        seed: Random seed. The result is reproducible bit for bit on the same machine, unless
            `time_limit` stops planning early.
        simultaneous: Plan all steps in one problem; otherwise each from the end of the one before,
            for comparison.
        window: Number of actions in one problem, for long lists of steps; None: all. An action is
            everything done with one object, from grasping it on. The window slides along the list
            by one action at a time, so that no grasp and no base pose is chosen from which the next
            action is infeasible.
        perturbation: Standard deviation of smooth noise on initial guesses, [m] and [rad].
        progress: Show a progress line in a notebook or terminal.
        terms: Additional constraints and costs; see `Constraint` and `Cost`.
        planner: Planner whose caches are used. Defaults to one per process.

    Returns:
        A plan in every case: `plan.success` is true only if the independent `validation` finds no
        violation. Ctrl-C, or interrupting a notebook's kernel, ends planning with the best
        trajectory so far and status "interrupted"; a second Ctrl-C raises KeyboardInterrupt. If a
        step of a window fails, the plan contains the steps before it and its best trajectory.

    Raises:
        InputError: An argument is invalid, or a step or term names an unknown or impossible goal.
    """
    budget = make_budget(time_limit, max_evaluations)
    request = make_request(
        scene,
        initialization=initialization,
        options=options,
        callback=callback,
        seed=seed,
        perturbation=perturbation,
        terms=terms,
    )
    simultaneous = check_bool(simultaneous, "simultaneous")
    if window is not None:
        window, steps = check_integer(window, "window", low=1), as_steps(steps)
        if not simultaneous:
            problem = "cannot be combined with `simultaneous=False`"
            raise InputError(problem, field="window", expected="None", got=window)
    with acquire_cache(planner) as cache, show_progress(progress) as line, budget.activate():
        request = dataclasses.replace(request, progress=line, cache=cache)
        tasks = _compile(scene, steps, request.options, each=window is not None)
        holds = dict.fromkeys(hold for task in tasks for hold in task.holds if hold.by is not None)
        # Attachments that would be approached from inside the object are reversed, with a warning.
        ready = scene.with_approaches(holds, stacklevel=3)
        check_terms_active(
            request.terms, [stretch for task in tasks for stretch in summarize_phases(task)]
        )
        check_footings(scene, tasks)
        check_loads(scene, tasks, request.options)

        def search(request: PlanningRequest) -> Plan:
            if window is not None:
                return plan_with_window(ready, steps, window, request)
            (task,) = tasks if ready is scene else _compile(ready, steps, request.options)
            # A chain can contain a joint only once.
            if not simultaneous or find_shared_coordinate(ready, task.holds) is not None:
                return plan_sequentially(ready, task, request)
            if len(task.steps) == 1:
                return solve_with_alternatives(ready, task, request).plan
            return plan_simultaneously(ready, task, request)

        found = _search_repeatedly(search, request, budget)
        found = _add_note_on_hand(_add_note_on_ending(found, budget), tasks)
        line.end(found)
    return found


def _search_repeatedly(
    search: Callable[[PlanningRequest], Plan], request: PlanningRequest, budget: Budget
) -> Plan:
    """Search until a plan is a success or proven to be impossible, or until the budget ends.

    Every search doubles the collision checks of trees, and draws other random numbers.
    """
    first = search(request)
    plans, seeds = [first], np.random.SeedSequence(request.random_seed)
    goes_on = request.initialization == "auto" and budget.is_limited
    while goes_on and not plans[-1].success and plans[-1].status not in FINAL:
        before = budget.evaluations
        (other,) = seeds.spawn(1)
        seed, effort = int(other.generate_state(1)[0]), 2 * request.effort
        request = dataclasses.replace(request, random_seed=seed, effort=effort)
        plans.append(search(request))
        goes_on = budget.evaluations > before
    # The first failure has the reasons; later ones end in the middle of a search.
    last = plans[-1]
    best = last if last.success or last.status == "infeasible" else first
    status = best.status if best.status in ("success", "infeasible") else last.status
    best = dataclasses.replace(best, status=status, seed=first.seed)
    return add_statistics(best, [each.statistics for each in plans])


def _add_note_on_ending(found: Plan, budget: Budget) -> Plan:
    """Return a plan; if no proof ended its search, with a note on what did."""
    options = {"time limit": "time_limit", "evaluation limit": "max_evaluations"}
    if found.status in options:
        limit = budget.describe_limit()
        note = f"the limit of {limit} ended the search; a larger {options[found.status]} goes on"
    elif found.status in ("not converged", "rejected"):
        note = "the search ended after all initial guesses; with a time_limit it goes on until then"
    else:
        return found
    report = dataclasses.replace(found.report, notes=(*found.report.notes, note))
    return dataclasses.replace(found, report=report)


def _add_note_on_hand(found: Plan, tasks: Sequence[Task]) -> Plan:
    """Return a plan; if it failed and its robot cannot grasp, with a note that says so."""
    robot = found.scene.robot
    holds = [hold for task in tasks for hold in task.holds if hold.by is None]
    if found.success or robot.touch_links or not holds:
        return found
    problem = f"no touch_links: the hand of '{robot.name}' may not touch {holds[0].object}"
    note = f"{problem}; name palm and fingers in its robot.yaml, or run vkc-pin import-robot"
    report = dataclasses.replace(found.report, notes=(*found.report.notes, note))
    return dataclasses.replace(found, report=report)


def _compile(
    scene: Scene, steps: Sequence[Step], options: Options, *, each: bool = False
) -> list[Task]:
    """Return the task of all steps, or with `each` the task of every action."""
    return (
        compile_each_step(scene, steps, options) if each else [compile_task(scene, steps, options)]
    )
