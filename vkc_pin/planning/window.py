"""A window that slides along a list of steps: what a chore is planned in, action after action."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.planning.initialization.initial_guess import (
    InitialGuess,
    PhaseWaypoints,
    make_initial_guess,
)
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.one_problem import OneProblem
from vkc_pin.planning.outcome import FINAL, joined
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.settings import Settings
from vkc_pin.utils.budget import ENDINGS
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.actions import generate_alternatives, group_into_actions
from vkc_pin.world.task.actuation import find_shared_coordinate
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.phases import Task
from vkc_pin.world.task.steps import Step
from vkc_pin.world.trajectory.splicing import extract_phases
from vkc_pin.world.trajectory.world_model import compute_final_scene

__all__ = ["SlidingWindow"]

_NOTHING = PhaseWaypoints((), (), (), "")


@dataclass(frozen=True, eq=False)
class _Part:
    """One action's part of a motion.

    Attributes:
        plan: The motion of the action alone, from the scene in which it begins; None if nothing is
            to be done.
        piece: Its waypoints.
        after: The scene in which it ends.
        rests: Whether the robot stands still at its end.
        checking: How long it took to check [s].
    """

    plan: Plan | None
    piece: PhaseWaypoints
    after: Scene
    rests: bool = True
    checking: float = 0.0


class SlidingWindow:
    """A list of steps that is being planned.

    Attributes:
        actions: The steps of each action, by the attachments that lead there.
        kept: What is decided: parts of the first actions.
        ahead: Parts of the actions after those, from which the next problem starts.
        spent, history: What every problem took, and every round of the solver.
    """

    def __init__(
        self, scene: Scene, steps: tuple[Step, ...], window: int, settings: Settings
    ) -> None:
        self.scene, self.steps, self.window, self.settings = scene, steps, window, settings
        self.actions = group_into_actions(steps)
        self.kept: list[_Part] = []
        self.ahead: list[_Part] = []
        self.spent: list[Mapping[str, float]] = []
        self.history: list[Mapping[str, float]] = []
        self.began = time.perf_counter()

    def run(self) -> Plan:
        """Plan action after action, until all is done, one fails or the budget is at its end."""
        window, back, failed = self.window, self._searches, None
        while len(self.kept) < len(self.actions):
            failed = self._plan_window(window)
            if self.settings.budget.ended:
                self.kept, self.ahead = self.kept + self.ahead, []
                break
            if failed is None:
                window = self.window
            elif self.kept and back and failed.status not in FINAL:
                self.kept.pop()
                while self.kept and not self.kept[-1].rests:
                    self.kept.pop()
                self.ahead, window, back = [], window + 1, back - 1
            else:
                self.kept, self.ahead = self.kept + self.ahead, []
                break
        return self._joined(failed)

    @property
    def _searches(self) -> int:
        """How often a motion is searched for, from different random numbers, and how often, in all, a decision is given up."""
        return self.settings.options.max_restarts

    @property
    def _now(self) -> Scene:
        return self.kept[-1].after if self.kept else self.scene

    def _plan_window(self, window: int) -> Plan | None:
        """Decide on the next action with those after it in mind.

        If that is not possible, return the plan of the first action that could not be planned, from
        where those ahead end.
        """
        first = len(self.kept)
        last = self._last(first, window)
        self.ahead = self.ahead[: last - first]
        alone = None
        while alone is None and first + len(self.ahead) < last and not self.settings.budget.ended:
            alone = self._look_ahead()
        if self.settings.budget.ended:
            return alone
        if alone is None and sum(part.plan is not None for part in self.ahead) > 1:
            pieces = [part.piece for part in self.ahead]
            one = self._problem(self._now, first, last)
            plan = self._solved(first, one, lambda problem: make_initial_guess(problem, pieces))
            if plan.success:
                self.ahead = self._parts(one, plan, first, last)
        for attempt in range(1, 1 + self._searches):
            if alone is None or alone.status in ENDINGS:
                break
            one = self._problem(self._now, first, last, attempt)
            together = self._solved(first, one)
            alone = None if together.success else dataclasses.replace(alone, status=together.status)
            if together.success:
                self.ahead = self._parts(one, together, first, last)
            elif together.status in FINAL:
                break
        if alone is None:
            self.kept.append(self.ahead.pop(0))
            while not self.kept[-1].rests:
                self.kept.append(self.ahead.pop(0))
        return alone

    def _last(self, first: int, window: int) -> int:
        """Return the end of a window: as wide as it may be.

        But without what can be said only once the rest is planned, or has no place in one chain
        with it.
        """
        last = first + 1
        while last < min(first + window, len(self.actions)):
            try:
                holds = self._task(self._now, first, last + 1, self.settings.options).holds
            except InputError:
                break
            if find_shared_coordinate(self._now, holds) is not None:
                break
            last += 1
        return last

    def _look_ahead(self) -> Plan | None:
        """Plan one more action alone, from where those planned ahead end; return the plan if it fails.

        What fails is tried by the other attachments that it leaves open; the one that leads there
        is the action's from then on.
        """
        number, scene = (
            len(self.kept) + len(self.ahead),
            self.ahead[-1].after if self.ahead else self._now,
        )
        failed, chosen = self._alone(number, scene), self.actions[number]
        if failed is None or failed.status in ENDINGS:
            return failed
        for _, steps in generate_alternatives(
            scene, self._task(scene, number, number + 1, self.settings.options)
        ):
            self.actions[number] = steps
            held_twice = (
                find_shared_coordinate(
                    scene, self._task(scene, number, number + 1, self.settings.options).holds
                )
                is not None
            )
            other = failed if held_twice else self._alone(number, scene, goals_first=True)
            if other is None:
                return None
            self.actions[number] = chosen
            if other.status in ENDINGS:
                return other
        return failed

    def _alone(self, number: int, scene: Scene, *, goals_first: bool = False) -> Plan | None:
        """Plan an action alone; return the plan if it fails."""
        for attempt in range(self._searches):
            one = self._problem(scene, number, number + 1, attempt, goals_first=goals_first)
            if not one.task.phases:
                self.ahead.append(_Part(None, _NOTHING, scene))
                return None
            plan = self._solved(number, one)
            if plan.success:
                self.ahead += self._parts(one, plan, number, number + 1)
                return None
            if plan.status in FINAL:
                break
        return plan

    def _solved(
        self,
        first: int,
        one: OneProblem,
        seed: Callable[[TrajectoryProblem], InitialGuess] | None = None,
    ) -> Plan:
        """Return the plan of a problem that begins with the action `first`."""
        done = len(self._steps(0, first))
        self.settings.progress.part(done + 1, len(one.task.steps), len(self.steps))
        self.settings.budget.decided = sum(part.checking for part in (*self.kept, *self.ahead))
        plan = one.run(seed)
        self.spent.append(plan.metrics)
        self.history += plan.history
        return plan

    def _parts(self, one: OneProblem, plan: Plan, first: int, last: int) -> list[_Part]:
        """Return the parts of a solved problem's motion in which the actions from `first` to before `last` are done."""
        scene, begin, parts, whole = one.scene, 0, [], one.piece()
        ahead = dict(enumerate(self.ahead, start=len(self.kept)))
        for number in range(first, last):
            task = one.task.truncate(len(self._steps(first, number + 1)))
            end = len(task.phases)
            names = [
                *one.scene.robot.coordinates.names,
                *(name for hold in task.holds for name in one.problem.chain.added[hold]),
            ]
            part, piece, rests = None, _NOTHING, True
            if end > begin:
                trajectory = extract_phases(
                    plan.trajectory, names, begin, end if end < len(one.task.phases) else None
                )
                steps = self._steps(number, number + 1)
                seed = (
                    ahead[number].piece.initialization if number in ahead else one.initialization
                )  # where it came from at first
                part = dataclasses.replace(
                    plan, scene=scene, steps=steps, trajectory=trajectory, initialization=seed
                )
                piece = PhaseWaypoints(
                    whole.phases[begin:end], whole.names, whole.waypoints[begin:end], seed
                )
                ends = one.problem.ends
                rests = (
                    end == len(ends) or ends[end - 1] in one.problem.transcription.structure.stops
                )
                scene = compute_final_scene(scene, trajectory, task.after)
            parts.append(_Part(part, piece, scene, rests, one.checking / (last - first)))
            begin = end
        return parts

    def _steps(self, first: int, last: int) -> tuple[Step, ...]:
        return tuple(step for action in self.actions[first:last] for step in action)

    def _task(self, scene: Scene, first: int, last: int, options: Options) -> Task:
        """Compile actions anew: from where in the world they begin is known only once those before them are planned."""
        return compile_task(scene, self._steps(first, last), options, nothing=True)

    def _problem(
        self, scene: Scene, first: int, last: int, attempt: int = 0, *, goals_first: bool = False
    ) -> OneProblem:
        """Return the problem of the actions from `first` to before `last`.

        There are few seeds to an attempt: where an action cannot be done from where the last one
        ends, all others fail as well, slowly, and to plan the two together is the way out.

        Args:
            scene: Where they begin.
            first: Their number.
            last: That of what follows.
            attempt: Other random numbers for each.
            goals_first: See `OneProblem`.
        """
        options = dataclasses.replace(self.settings.options, max_restarts=1)
        settings = dataclasses.replace(
            self.settings, options=options, random_seed=self.settings.random_seed + attempt
        )
        return OneProblem(
            scene, self._task(scene, first, last, options), settings, goals_first=goals_first
        )

    def _joined(self, failed: Plan | None) -> Plan:
        """Return one plan of all that is decided, and of what failed."""
        parts = [part.plan for part in self.kept if part.plan is not None]
        notes = []
        if failed is not None:
            parts.append(failed)
            number = len(self._steps(0, len(self.kept)))
            notes.append(
                f"steps[{number}], {self._steps(0, len(self.actions))[number]}, could not be planned: {failed.status}"
            )
        return joined(
            self.scene,
            self._steps(0, len(self.actions)),
            self.settings,
            parts,
            began=self.began,
            metrics=self.spent,
            notes=notes,
            history=self.history,
        )
