"""Plans the trajectory of steps: `plan`, and `prepare` for many similar calls."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.planning.initialization.methods import Initialization
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.planner import Planner, acquire_cache
from vkc_pin.planning.progress import show_progress
from vkc_pin.planning.request import PlanningRequest, make_budget, make_request
from vkc_pin.planning.results import FINAL
from vkc_pin.planning.schedule import Schedule, carry_out
from vkc_pin.planning.sequential import plan_as_one, plan_from_motion, plan_sequentially
from vkc_pin.planning.solver.solution import Iteration
from vkc_pin.planning.window import plan_with_window
from vkc_pin.utils.arguments import check_bool, check_instance, check_integer
from vkc_pin.utils.budget import Budget
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.actions import compile_each_step
from vkc_pin.world.task.actuation import find_shared_coordinate
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.loads import check_footings, check_loads
from vkc_pin.world.task.phases import Task, summarize_phases
from vkc_pin.world.task.steps import Step, as_steps
from vkc_pin.world.task.terms import Term, check_terms_active, trace_terms
from vkc_pin.world.trajectory.trajectory import Trajectory


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
    guess: Plan | Trajectory | None = None,
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
        guess: An earlier plan or motion of these steps, perhaps in a slightly different scene, from
            which the search starts. Its phases are matched by their names. If no solution is found
            from there, the usual search follows, within the same limits. Without effect with
            `window`, with `simultaneous=False`, and where the steps cannot be planned as one
            problem.
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
    prepared = prepare(
        scene,
        steps,
        options=options,
        simultaneous=simultaneous,
        window=window,
        terms=terms,
        planner=planner,
    )
    return prepared.solve(
        initialization=initialization,
        callback=callback,
        time_limit=time_limit,
        max_evaluations=max_evaluations,
        seed=seed,
        guess=guess,
        perturbation=perturbation,
        progress=progress,
    )


def prepare(
    scene: Scene,
    steps: Sequence[Step],
    *,
    options: Options | None = None,
    simultaneous: bool = True,
    window: int | None = None,
    terms: Sequence[Term] = (),
    planner: Planner | None = None,
) -> PreparedTask:
    """Check and prepare steps that are planned many times, in scenes that differ a little.

    `plan(...)` is `prepare(...).solve(...)`.

    Args:
        scene: Scene in which the steps are checked, and planned unless `solve` is given another.
        steps: See `plan`, as for all other arguments.
        options: Options of planning.
        simultaneous: Plan all steps in one problem.
        window: Number of actions in one problem.
        terms: Additional constraints and costs.
        planner: Planner whose caches are used. Defaults to one per process.

    Raises:
        InputError: An argument is invalid, or a step or term names an unknown or impossible goal.
    """
    check_instance(scene, Scene, "scene")
    options = Options() if options is None else check_instance(options, Options, "options")
    simultaneous = check_bool(simultaneous, "simultaneous")
    if window is not None:
        window = check_integer(window, "window", low=1)
        if not simultaneous:
            problem = "cannot be combined with `simultaneous=False`"
            raise InputError(problem, field="window", expected="None", got=window)
    steps = as_steps(steps)
    traced = trace_terms(scene, terms)
    tasks = _compile(scene, steps, options, traced, each=window is not None)
    return PreparedTask(scene, steps, options, traced, simultaneous, window, planner, tasks)


@dataclass(frozen=True, eq=False)
class PreparedTask:
    """Steps that have been checked, to be planned any number of times; made by `prepare`.

    Attributes:
        scene: Scene in which they were checked.
        steps, options, terms, simultaneous, window: See `plan`.
        planner: Planner whose caches are used; None: the process's own.
        tasks: The task of all steps in this scene, or with a window those of all actions.
    """

    scene: Scene
    steps: tuple[Step, ...]
    options: Options
    terms: tuple[Term, ...]
    simultaneous: bool
    window: int | None
    planner: Planner | None
    tasks: Sequence[Task] = field(repr=False)

    def solve(
        self,
        *,
        scene: Scene | None = None,
        guess: Plan | Trajectory | None = None,
        initialization: Initialization = "auto",
        callback: Callable[[Iteration], None] | None = None,
        time_limit: float | None = None,
        max_evaluations: int | None = None,
        seed: int = 0,
        perturbation: float = 0.0,
        progress: bool = False,
        explain: bool = True,
    ) -> Plan:
        """Plan the steps; see `plan`.

        Args:
            scene: The world as it is now: the start, placements of objects and obstacles, and
                measured grasps may differ from those of the prepared scene. Default: as prepared.
            guess: Earlier plan or motion from which the search starts.
            initialization: Initialization method.
            callback: Called after every round of the solver.
            time_limit: Wall-clock limit [s].
            max_evaluations: Limit on evaluated configurations.
            seed: Random seed.
            perturbation: Standard deviation of noise on initial guesses.
            progress: Show a progress line.
            explain: Whether a failure has the best motion that was found, validated, and notes on
                its causes. That may take longer than `time_limit`; otherwise its motion stands
                still.

        Raises:
            InputError: An argument is invalid, or the steps are impossible in this scene.
        """
        scene = self.scene if scene is None else check_instance(scene, Scene, "scene")
        explain = check_bool(explain, "explain")
        budget = make_budget(time_limit, max_evaluations)
        request = make_request(
            scene,
            initialization=initialization,
            options=self.options,
            callback=callback,
            seed=seed,
            perturbation=perturbation,
            guess=guess,
            terms=self.terms,
        )
        with (
            acquire_cache(self.planner) as cache,
            show_progress(progress) as line,
            budget.activate(),
        ):
            request = dataclasses.replace(request, progress=line, cache=cache, explains=explain)
            tasks = self._compile(scene)
            holds = [hold for task in tasks for hold in task.holds if hold.by is not None]
            # Attachments approached from inside the object are reversed, with a warning.
            ready = scene.with_approaches(dict.fromkeys(holds), stacklevel=4)
            if ready is not scene:
                tasks = self._compile(ready)
            plan_once = functools.partial(self._plan_once, ready, tasks)
            found = carry_out(_plan_repeatedly(plan_once, request, budget))
            found = dataclasses.replace(found, statistics=request.log.statistics)
            found = _add_note_on_ending(found, budget)
            found = _add_note_on_hand(found, tasks)
            line.end(found)
        return found

    def _compile(self, scene: Scene) -> Sequence[Task]:
        if scene is self.scene:
            return self.tasks
        each = self.window is not None
        return _compile(scene, self.steps, self.options, self.terms, each=each)

    def _plan_once(
        self, scene: Scene, tasks: Sequence[Task], request: PlanningRequest
    ) -> Schedule[Plan]:
        if self.window is not None:
            return plan_with_window(scene, self.steps, self.window, request)
        (task,) = tasks
        # A chain can contain a joint only once.
        is_one_problem = find_shared_coordinate(scene, task.holds) is None
        if not self.simultaneous or not is_one_problem:
            return plan_sequentially(scene, task, request)
        if request.guess is not None:
            return plan_from_motion(scene, task, request)
        return plan_as_one(scene, task, request)


def _compile(
    scene: Scene,
    steps: tuple[Step, ...],
    options: Options,
    terms: tuple[Term, ...],
    *,
    each: bool,
) -> Sequence[Task]:
    """Return the checked task of all steps in a scene, or with `each` the task of every action.

    Raises:
        InputError: The steps or terms are impossible there.
    """
    if each:
        tasks = compile_each_step(scene, steps, options)
    else:
        tasks = [compile_task(scene, steps, options)]
    check_terms_active(terms, [span for task in tasks for span in summarize_phases(task)])
    check_footings(scene, tasks)
    check_loads(scene, tasks, options)
    return tasks


def _plan_repeatedly(
    plan_once: Callable[[PlanningRequest], Schedule[Plan]],
    request: PlanningRequest,
    budget: Budget,
) -> Schedule[Plan]:
    """Plan until a plan is a success or proven to be impossible, or until the budget ends.

    Every repetition doubles the collision checks of trees, and draws other random numbers.
    """
    first = yield from plan_once(request)
    last = first
    seeds = np.random.SeedSequence(request.random_seed)
    goes_on = request.initialization == "auto" and budget.is_limited
    while goes_on and not last.success and last.status not in FINAL:
        before = budget.evaluations
        (other,) = seeds.spawn(1)
        seed = int(other.generate_state(1)[0])
        request = dataclasses.replace(
            request, random_seed=seed, check_factor=2 * request.check_factor
        )
        last = yield from plan_once(request)
        goes_on = budget.evaluations > before
    if last.success or last.status == "infeasible":
        return dataclasses.replace(last, seed=first.seed)
    # The first failure has the reasons; later ones end in the middle of a search.
    return dataclasses.replace(first, status=last.status)


def _add_note_on_ending(found: Plan, budget: Budget) -> Plan:
    """Return a plan; if no proof ended its search, with a note on what did."""
    options = {"time limit": "time_limit", "evaluation limit": "max_evaluations"}
    if found.status in options:
        limit = budget.describe_limit(found.status)
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
