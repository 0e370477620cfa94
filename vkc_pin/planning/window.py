"""Plans a long list of steps in a window of actions that slides along it."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from vkc_pin.errors import InputError
from vkc_pin.planning.alternatives import try_alternatives
from vkc_pin.planning.initialization.initial_guess import PhaseWaypoints, make_initial_guess
from vkc_pin.planning.plan import Plan, PlanningStatistics
from vkc_pin.planning.request import PlanningRequest
from vkc_pin.planning.results import FINAL, concatenate_plans
from vkc_pin.planning.solve_task import Guess, TaskResult, solve_task
from vkc_pin.utils.budget import current_ending, reserve_time
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.actions import generate_alternatives, group_into_actions
from vkc_pin.world.task.actuation import find_shared_coordinate
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.phases import Task
from vkc_pin.world.task.steps import Step, describe_step
from vkc_pin.world.trajectory.splicing import extract_phases
from vkc_pin.world.trajectory.world_model import compute_final_scene

_NOTHING = PhaseWaypoints((), (), (), "")


def plan_with_window(
    scene: Scene, steps: Sequence[Step], window: int, request: PlanningRequest
) -> Plan:
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
    """Plan of one action (None: nothing to do), its waypoints, and the scene at its end."""

    plan: Plan | None
    waypoints: PhaseWaypoints
    after: Scene
    is_at_rest: bool = True
    check_time: float = 0.0


@dataclass(frozen=True)
class _Attempts:
    """Search that solves a task with several random seeds; its caller counts the statistics."""

    solve: Callable[[], TaskResult]
    statistics: PlanningStatistics = field(default_factory=PlanningStatistics)

    def run(self, *, pauses: bool = False) -> TaskResult:
        return self.solve()


class _SlidingWindow:
    """State of planning a list of steps.

    Attributes:
        actions: Steps of each action, with the attachments that lead to success.
        decided: Accepted parts of the first actions.
        ahead: Parts of the next actions, from which the next problem starts.
    """

    def __init__(
        self, scene: Scene, steps: tuple[Step, ...], window: int, request: PlanningRequest
    ) -> None:
        self.scene, self.steps, self.window, self.request = scene, steps, window, request
        self.actions = group_into_actions(steps)
        self.decided: list[_Part] = []
        self.ahead: list[_Part] = []
        self.statistics: list[PlanningStatistics] = []
        self.history: list[Mapping[str, float]] = []
        self.began = time.perf_counter()
        # Number of attempts with other random seeds, and of decisions that may be revoked in all.
        self._attempts = request.options.max_restarts
        self._options = dataclasses.replace(request.options, max_restarts=1)

    def run(self) -> Plan:
        """Plan action after action until all are planned, one fails or the budget ends."""
        window, revocations, failed = self.window, self._attempts, None
        while len(self.decided) < len(self.actions):
            failed = self._plan_window(window)
            if current_ending():
                self.decided, self.ahead = self.decided + self.ahead, []
                break
            if failed is None:
                window = self.window
            elif self.decided and revocations and self._may_be_revoked(failed):
                self.decided.pop()
                while self.decided and not self.decided[-1].is_at_rest:
                    self.decided.pop()
                self.ahead, window, revocations = [], window + 1, revocations - 1
            else:
                self.decided, self.ahead = self.decided + self.ahead, []
                break
        return self._concatenate(failed)

    def _may_be_revoked(self, failed: Plan) -> bool:
        """Return whether the next action, which failed, may be feasible after other decisions.

        They decide how objects are held.
        """
        held_anew = {*self._current_scene.holds} - {*self.scene.holds}
        return failed.status != "infeasible" or bool(held_anew)

    @property
    def _current_scene(self) -> Scene:
        return self.decided[-1].after if self.decided else self.scene

    def _plan_window(self, window: int) -> Plan | None:
        """Decide on the next action together with those after it; return the plan of a failure."""
        first = len(self.decided)
        last = self._find_last(first, window)
        self.ahead = self.ahead[: last - first]
        failed = None
        while failed is None and first + len(self.ahead) < last and not current_ending():
            failed = self._look_ahead()
        if current_ending():
            return failed
        task = self._compile(self._current_scene, first, last)
        if failed is None and sum(part.plan is not None for part in self.ahead) > 1:
            pieces = [part.waypoints for part in self.ahead]
            guess = functools.partial(make_initial_guess, parts=pieces)
            result = self._solve(first, self._current_scene, task, guess=guess)
            if result.plan.success:
                self.ahead = self._divide(result, first, last)
        if failed is not None and not current_ending():
            # If the first action fails, its alternatives have been tried.
            solve = self._solve_with_alternatives if self.ahead else self._solve_repeatedly
            result = solve(first, self._current_scene, task, range(1, 1 + self._attempts))
            if result.plan.success:
                self._name_attachments(first, result.plan.steps)
                failed, self.ahead = None, self._divide(result, first, last)
            else:
                failed = dataclasses.replace(failed, status=result.plan.status)
        if failed is None:
            self.decided.append(self.ahead.pop(0))
            while not self.decided[-1].is_at_rest:
                self.decided.append(self.ahead.pop(0))
        return failed

    def _find_last(self, first: int, window: int) -> int:
        """Return the end of the window.

        It ends before actions that can be compiled only once the others are planned, and before
        holds that cannot be in one chain with theirs.
        """
        last = first + 1
        while last < min(first + window, len(self.actions)):
            try:
                holds = self._compile(self._current_scene, first, last + 1).holds
            except InputError:
                break
            if find_shared_coordinate(self._current_scene, holds) is not None:
                break
            last += 1
        return last

    def _look_ahead(self) -> Plan | None:
        """Plan one more action alone, from the end of those ahead; return its plan if it fails.

        After a failure other attachments are tried; the first success determines the attachment.
        """
        number = len(self.decided) + len(self.ahead)
        scene = self.ahead[-1].after if self.ahead else self._current_scene
        task = self._compile(scene, number, number + 1)
        if not task.phases:
            self.ahead.append(_Part(None, _NOTHING, scene))
            return None
        result = self._solve_with_alternatives(number, scene, task, range(self._attempts))
        if not result.plan.success:
            return result.plan
        self.actions[number] = result.plan.steps
        self.ahead += self._divide(result, number, number + 1)
        return None

    def _solve_with_alternatives(
        self, first: int, scene: Scene, task: Task, attempts: Sequence[int]
    ) -> TaskResult:
        """Solve a task that begins with the action `first`, if need be with other attachments."""

        def solve(steps: Sequence[Step]) -> TaskResult:
            other = compile_task(scene, steps, self._options)
            if find_shared_coordinate(scene, other.holds) is not None:
                raise InputError("its grasps cannot be part of one problem")
            return self._solve_repeatedly(first, scene, other, attempts, check_goals_first=True)

        return try_alternatives(
            _Attempts(functools.partial(self._solve_repeatedly, first, scene, task, attempts)),
            functools.partial(generate_alternatives, task),
            solve,
            pauses=False,
        )

    def _solve_repeatedly(
        self,
        first: int,
        scene: Scene,
        task: Task,
        attempts: Sequence[int],
        *,
        check_goals_first: bool = False,
    ) -> TaskResult:
        """Solve a task with one random seed after the other, until that is final."""
        for attempt in attempts:
            result = self._solve(first, scene, task, attempt, check_goals_first=check_goals_first)
            if result.plan.success or result.plan.status in FINAL:
                break
        return result

    def _solve(
        self,
        first: int,
        scene: Scene,
        task: Task,
        attempt: int = 0,
        *,
        guess: Guess | None = None,
        check_goals_first: bool = False,
    ) -> TaskResult:
        """Solve a task that begins with the action `first`.

        Each attempt has few initial guesses: where an action is infeasible from the end of the one
        before, all of them fail slowly, and planning both together is the solution.
        """
        request = dataclasses.replace(
            self.request,
            options=self._options,
            random_seed=self.request.random_seed + attempt,
        )
        done = len(self._steps(0, first))
        request.progress.set_steps(done + 1, len(task.steps), len(self.steps))
        reserved = sum(part.check_time for part in (*self.decided, *self.ahead))
        reserve_time("planned actions", reserved)
        result = solve_task(scene, task, request, guess=guess, check_goals_first=check_goals_first)
        self.statistics.append(result.plan.statistics)
        self.history += result.plan.history
        return result

    def _divide(self, result: TaskResult, first: int, last: int) -> list[_Part]:
        """Return the parts of a result in which the actions `first` to `last` − 1 are done."""
        problem = result.problem
        assert problem is not None
        scene, begin, parts, whole = result.scene, 0, list[_Part](), result.phase_waypoints()
        ahead = dict(enumerate(self.ahead, start=len(self.decided)))
        for number in range(first, last):
            task = result.task.truncate(len(self._steps(first, number + 1)))
            end = len(task.phases)
            names = [
                *result.scene.robot.coordinates.names,
                *(name for hold in task.holds for name in problem.chain.added[hold]),
            ]
            part, waypoints, is_at_rest = None, _NOTHING, True
            if end > begin:
                until = end if end < len(result.task.phases) else None
                trajectory = extract_phases(result.plan.trajectory, names, begin, until)
                # The initial guess that the action was planned from at first.
                known = ahead[number].waypoints.initialization if number in ahead else None
                name = result.plan.initialization if known is None else known
                part = dataclasses.replace(
                    result.plan,
                    scene=scene,
                    steps=self._steps(number, number + 1),
                    trajectory=trajectory,
                    initialization=name,
                )
                waypoints = PhaseWaypoints(
                    whole.phases[begin:end], whole.names, whole.waypoints[begin:end], name
                )
                ends, stops = problem.ends, problem.transcription.structure.stops
                is_at_rest = end == len(ends) or ends[end - 1] in stops
                scene = compute_final_scene(scene, trajectory, task.after)
            check_time = result.check_time / (last - first)
            parts.append(_Part(part, waypoints, scene, is_at_rest, check_time))
            begin = end
        return parts

    def _name_attachments(self, first: int, steps: Sequence[Step]) -> None:
        """Replace the steps of actions, from `first` on, by the same with named attachments."""
        remaining = iter(steps)
        last = first
        while len(self._steps(first, last)) < len(steps):
            count = len(self.actions[last])
            self.actions[last] = tuple(itertools.islice(remaining, count))
            last += 1

    def _steps(self, first: int, last: int) -> tuple[Step, ...]:
        return tuple(step for action in self.actions[first:last] for step in action)

    def _compile(self, scene: Scene, first: int, last: int) -> Task:
        return compile_task(scene, self._steps(first, last), self._options, nothing=True)

    def _concatenate(self, failed: Plan | None) -> Plan:
        """Return one plan of all decided actions and of the one that failed."""
        parts = [part.plan for part in self.decided if part.plan is not None]
        notes, steps = [], self._steps(0, len(self.actions))
        if failed is not None:
            parts.append(failed)
            number = len(self._steps(0, len(self.decided)))
            step = f"steps[{number}], {describe_step(steps[number])}"
            notes.append(f"{step}, could not be planned: {failed.status}")
        return concatenate_plans(
            self.scene,
            steps,
            self.request,
            parts,
            began=self.began,
            statistics=self.statistics,
            notes=notes,
            history=self.history,
        )
