"""Remembers why a task fails, as far as that is known."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable

from vkc_pin.planning.diagnosis.diagnosis import (
    BlockedGoal,
    describe_free_range,
    diagnose_goal,
    find_impossible_conditions,
)
from vkc_pin.planning.diagnosis.proofs import find_proofs, find_swept_collisions
from vkc_pin.planning.nlp.kinematic_problem import KinematicProblem
from vkc_pin.utils.budget import BudgetExhaustedError
from vkc_pin.validation.report import Violation


class TaskDiagnosis:
    """Diagnoses one task; everything is computed when it is first needed, and once.

    Args:
        random_seed: Random seed of searches for collision-free configurations.

    Attributes:
        is_grasp_independent: Whether the task is known to fail for certain whatever the grasp.
        proofs: Known proofs of infeasibility; None: none has been looked for.
    """

    def __init__(self, random_seed: int) -> None:
        self.is_grasp_independent = False
        self.proofs: list[str] | None = None
        self._random_seed = random_seed
        self._goals: dict[int, BlockedGoal | None] = {}

    def find_conditions(self, problem: KinematicProblem) -> list[Violation]:
        """Return conditions at start and goals that no motion can satisfy."""
        conditions = find_impossible_conditions(problem)
        if conditions:
            self.is_grasp_independent = True
        return conditions

    def find_proofs(self, problem: KinematicProblem) -> list[str]:
        """Return proofs of infeasibility; without any, the result is empty."""
        if self.proofs is None:
            collisions = find_swept_collisions(problem)
            proofs = collisions or find_proofs(problem)
            self.is_grasp_independent = bool(collisions)
            self.proofs = proofs
        return self.proofs

    def find_blocked_goals(
        self, problem: KinematicProblem, numbers: Iterable[int] | None = None
    ) -> list[BlockedGoal]:
        """Return the goals of phases without a known collision-free configuration.

        Args:
            problem: Problem of the task.
            numbers: Numbers of the phases; None: all.
        """
        if numbers is None:
            numbers = range(len(problem.task.phases))
        blocked = []
        for number in numbers:
            if number not in self._goals:
                self._goals[number] = diagnose_goal(problem, number, self._random_seed)
            goal = self._goals[number]
            if goal is not None:
                blocked.append(goal)
        return blocked

    def is_infeasible(self, problem: KinematicProblem, numbers: Iterable[int]) -> bool:
        """Return whether a task is proven infeasible, or a goal of some phases blocked deeply.

        Args:
            problem: Problem of the task.
            numbers: Numbers of the phases.
        """
        if self.find_proofs(problem):
            return True
        return any(goal.is_deep for goal in self.find_blocked_goals(problem, numbers))

    def describe_goal(self, problem: KinematicProblem, goal: BlockedGoal) -> str:
        """Return why a goal is blocked, and how far it is free, within the budget."""
        free = ""
        with contextlib.suppress(BudgetExhaustedError):
            free = describe_free_range(problem, goal.phase, self._random_seed)
        if not free:
            return goal.text
        return f"{goal.text}; free configurations were found up to {free}"
