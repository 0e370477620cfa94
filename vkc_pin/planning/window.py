"""Plans a long list of steps in a window of actions that slides along it."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass

from vkc_pin.errors import InputError
from vkc_pin.planning.alternatives import solve_with_alternatives
from vkc_pin.planning.initialization.initial_guess import PhaseWaypoints, make_initial_guess
from vkc_pin.planning.plan import Plan, PlanningStatistics
from vkc_pin.planning.request import PlanningRequest
from vkc_pin.planning.results import concatenate_plans
from vkc_pin.planning.schedule import Schedule, solve
from vkc_pin.planning.solve_task import TaskResult
from vkc_pin.utils.budget import current_ending, reserve_time
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.actions import group_into_actions
from vkc_pin.world.task.actuation import find_shared_coordinate
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.phases import Task
from vkc_pin.world.task.steps import Step, describe_step
from vkc_pin.world.trajectory.splicing import extract_phases
from vkc_pin.world.trajectory.world_model import compute_final_scene

_NOTHING = PhaseWaypoints((), (), (), "")


def plan_with_window(
    scene: Scene, steps: Sequence[Step], window: int, request: PlanningRequest
) -> Schedule[Plan]:
    """Plan action after action, each together with the next ones.

    An action is everything done with one object, from grasping it on. `window` consecutive actions
    are planned as one problem; the trajectory of the first is accepted, and the window moves on by
    one, from the state in which that trajectory ends. So no grasp and no base pose is chosen from
    which the next action is infeasible. If it is all the same, the last decision is revoked and
    planned again with one more action in the window.
    """
    return _SlidingWindow(scene, tuple(steps), window, request).run()


@dataclass(frozen=True, eq=False)
class _Part:
    """Plan of one action.

    Attributes:
        plan: The plan; None: nothing is to do.
        waypoints: Its waypoints.
        after: Scene at its end.
        is_at_rest: Whether the motion stops there.
        check_time: Time of its validation [s].
    """

    plan: Plan | None
    waypoints: PhaseWaypoints
    after: Scene
    is_at_rest: bool = True
    check_time: float = 0.0


class _SlidingWindow:
    """State of planning a list of steps.

    Args:
        scene: Scene in which the first action starts.
        steps: The steps.
        window: Number of actions that are planned as one problem.
        request: Arguments of planning.
    """

    def __init__(
        self, scene: Scene, steps: tuple[Step, ...], window: int, request: PlanningRequest
    ) -> None:
        self._scene = scene
        self._window = window
        # Each attempt has few initial guesses: where an action is infeasible from the end of the
        # one before, all of them fail slowly, and planning both together is the solution.
        self._options = dataclasses.replace(request.options, max_restarts=1)
        self._request = request
        # Number of attempts with other random seeds, and of decisions that may be revoked in all.
        self._attempts = request.options.max_restarts
        # Steps of each action, with the attachments that lead to success.
        self._actions = group_into_actions(steps)
        self._decided: list[_Part] = []  # accepted parts of the first actions
        self._ahead: list[_Part] = []  # those of the next, from which the next problem starts
        self._began = time.perf_counter()
        self._statistics_before = request.log.statistics
        self._rows_before = len(request.log.history)

    def run(self) -> Schedule[Plan]:
        """Plan action after action until all are planned, one fails or the budget ends."""
        window = self._window
        revocations = self._attempts
        failed = None
        while len(self._decided) < len(self._actions):
            failed = yield from self._plan_window(window)
            if current_ending():
                break
            if failed is None:
                window = self._window
            elif self._decided and revocations and self._may_be_revoked(failed):
                self._revoke_decision()
                window += 1
                revocations -= 1
            else:
                break
        self._decided += self._ahead
        plan = self._concatenate(failed)
        self._count_time_between()
        return plan

    def _may_be_revoked(self, failed: Plan) -> bool:
        """Return whether the next action, which failed, may be feasible after other decisions.

        They decide how objects are held.
        """
        held_anew = {*self._current_scene.holds} - {*self._scene.holds}
        return failed.status != "infeasible" or bool(held_anew)

    def _revoke_decision(self) -> None:
        """Revoke the last decision, with those before it at whose ends the motion goes on."""
        self._decided.pop()
        while self._decided and not self._decided[-1].is_at_rest:
            self._decided.pop()
        self._ahead = []

    @property
    def _current_scene(self) -> Scene:
        return self._decided[-1].after if self._decided else self._scene

    def _plan_window(self, window: int) -> Schedule[Plan | None]:
        """Decide on the next action together with those after it; return the plan of a failure."""
        first = len(self._decided)
        last = self._find_last(first, window)
        self._ahead = self._ahead[: last - first]
        failed = None
        while failed is None and first + len(self._ahead) < last and not current_ending():
            failed = yield from self._plan_next_action()
        if current_ending():
            return failed
        scene = self._current_scene
        task = self._compile(scene, first, last)
        planned = [part for part in self._ahead if part.plan is not None]
        if failed is not None:
            requests = self._make_requests(first, task, range(1, 1 + self._attempts))
            # If the first action fails, its alternatives have been tried.
            solve_again = solve_with_alternatives if self._ahead else solve
            result = yield from solve_again(scene, task, requests)
            if not result.plan.success:
                return dataclasses.replace(failed, status=result.plan.status)
            self._name_attachments(first, result.plan.steps)
            self._ahead = self._divide(result, first, last)
        elif len(planned) > 1:
            waypoints = [part.waypoints for part in self._ahead]
            guess = functools.partial(make_initial_guess, parts=waypoints)
            requests = self._make_requests(first, task, [0])
            result = yield from solve(scene, task, requests, guess=guess)
            if result.plan.success:
                self._ahead = self._divide(result, first, last)
        self._decided.append(self._ahead.pop(0))
        while not self._decided[-1].is_at_rest:
            self._decided.append(self._ahead.pop(0))
        return None

    def _find_last(self, first: int, window: int) -> int:
        """Return the end of the window.

        It ends before actions that can be compiled only once the others are planned, and before
        holds that cannot be in one chain with theirs.
        """
        last = first + 1
        while last < min(first + window, len(self._actions)):
            try:
                holds = self._compile(self._current_scene, first, last + 1).holds
            except InputError:
                break
            if find_shared_coordinate(self._current_scene, holds) is not None:
                break
            last += 1
        return last

    def _plan_next_action(self) -> Schedule[Plan | None]:
        """Plan one more action alone, from the end of those ahead; return its plan if it fails.

        After a failure other attachments are tried; the first success determines the attachment.
        """
        number = len(self._decided) + len(self._ahead)
        scene = self._ahead[-1].after if self._ahead else self._current_scene
        task = self._compile(scene, number, number + 1)
        if not task.phases:
            self._ahead.append(_Part(None, _NOTHING, scene))
            return None
        requests = self._make_requests(number, task, range(self._attempts))
        result = yield from solve_with_alternatives(scene, task, requests)
        if not result.plan.success:
            return result.plan
        self._actions[number] = result.plan.steps
        self._ahead += self._divide(result, number, number + 1)
        return None

    def _make_requests(
        self, first: int, task: Task, attempts: Sequence[int]
    ) -> list[PlanningRequest]:
        """Return the arguments of planning a task that begins with the action `first`.

        Args:
            first: Number of the action.
            task: The task.
            attempts: Numbers of attempts, each with its own random numbers.
        """
        done = len(self._steps(0, first))
        self._request.progress.set_steps(done + 1, len(task.steps), len(self._steps()))
        reserved = sum(part.check_time for part in (*self._decided, *self._ahead))
        reserve_time("planned actions", reserved)
        requests = []
        for attempt in attempts:
            seed = self._request.random_seed + attempt
            request = dataclasses.replace(self._request, options=self._options, random_seed=seed)
            requests.append(request)
        return requests

    def _divide(self, result: TaskResult, first: int, last: int) -> list[_Part]:
        """Return the parts of a result in which the actions `first` to `last` − 1 are done."""
        scene = result.scene
        parts = list[_Part]()
        check_time = result.check_time / (last - first)
        begin = 0
        for number in range(first, last):
            task = result.task.truncate(len(self._steps(first, number + 1)))
            end = len(task.phases)
            if end > begin:
                part = self._extract_part(result, scene, number, task, begin)
            else:
                part = _Part(None, _NOTHING, scene)
            parts.append(dataclasses.replace(part, check_time=check_time))
            scene = part.after
            begin = end
        return parts

    def _extract_part(
        self, result: TaskResult, scene: Scene, number: int, task: Task, begin: int
    ) -> _Part:
        """Return the part of a result in which one action is done.

        Args:
            result: The result.
            scene: Scene in which the action starts.
            number: Number of the action.
            task: Task of all steps of the result up to the end of the action.
            begin: Number of the result's phases before the action.
        """
        problem = result.problem
        assert problem is not None
        end = len(task.phases)
        names = [*scene.robot.coordinates.names]
        for hold in task.holds:
            names += problem.chain.added[hold]
        until = end if end < len(result.task.phases) else None
        trajectory = extract_phases(result.plan.trajectory, names, begin, until)
        # The initial guess that the action was planned from at first.
        initialization = result.plan.initialization
        place = number - len(self._decided)
        if place < len(self._ahead):
            initialization = self._ahead[place].waypoints.initialization
        plan = dataclasses.replace(
            result.plan,
            scene=scene,
            steps=self._steps(number, number + 1),
            trajectory=trajectory,
            initialization=initialization,
        )
        whole = result.phase_waypoints()
        waypoints = PhaseWaypoints(
            whole.phases[begin:end], whole.names, whole.waypoints[begin:end], initialization
        )
        stops = problem.transcription.structure.stops
        is_at_rest = end == len(problem.ends) or problem.ends[end - 1] in stops
        after = compute_final_scene(scene, trajectory, task.after)
        return _Part(plan, waypoints, after, is_at_rest)

    def _name_attachments(self, first: int, steps: Sequence[Step]) -> None:
        """Replace the steps of actions, from `first` on, by the same with named attachments."""
        remaining = iter(steps)
        last = first
        while len(self._steps(first, last)) < len(steps):
            count = len(self._actions[last])
            self._actions[last] = tuple(itertools.islice(remaining, count))
            last += 1

    def _steps(self, first: int = 0, last: int | None = None) -> tuple[Step, ...]:
        """Return the steps of the actions from `first` on, up to `last` − 1 (None: all)."""
        return tuple(itertools.chain.from_iterable(self._actions[first:last]))

    def _compile(self, scene: Scene, first: int, last: int) -> Task:
        return compile_task(scene, self._steps(first, last), self._options, nothing=True)

    def _concatenate(self, failed: Plan | None) -> Plan:
        """Return one plan of all decided actions and of the one that failed."""
        parts = [part.plan for part in self._decided if part.plan is not None]
        steps = self._steps()
        notes = []
        if failed is not None:
            parts.append(failed)
            number = len(self._steps(0, len(self._decided)))
            step = f"steps[{number}], {describe_step(steps[number])}"
            notes.append(f"{step}, could not be planned: {failed.status}")
        history = self._request.log.history[self._rows_before :]
        return concatenate_plans(
            self._scene, steps, self._request, parts, notes=notes, history=history
        )

    def _count_time_between(self) -> None:
        """Add the time between searches, in which tasks are compiled and results divided."""
        log = self._request.log
        before = self._statistics_before
        counted = log.statistics.planning_time - before.planning_time
        counted += log.statistics.build_time - before.build_time
        took = time.perf_counter() - self._began
        log.add(PlanningStatistics(planning_time=took - counted))
