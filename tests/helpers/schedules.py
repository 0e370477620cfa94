"""Carries out parts of the schedules of a planning call."""

from __future__ import annotations

from vkc_pin.planning import schedule, sequential
from vkc_pin.planning.request import PlanningRequest
from vkc_pin.planning.sequential import PlannedStep
from vkc_pin.planning.solve_task import Guess, TaskResult
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.phases import Task


def solve_task(
    scene: Scene, task: Task, request: PlanningRequest, *, guess: Guess | None = None
) -> TaskResult:
    """Solve a task as one nonlinear program."""
    return schedule.carry_out(schedule.solve(scene, task, [request], guess=guess))


def plan_each_step(scene: Scene, task: Task, request: PlanningRequest) -> list[PlannedStep]:
    """Plan every step of a task from the end of the one before."""
    return schedule.carry_out(sequential.plan_each_step(scene, task, request))
