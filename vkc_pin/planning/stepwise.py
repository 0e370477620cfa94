"""Steps all at once, or one after the other; each by the attachment that leads there, where the user leaves that open."""

from __future__ import annotations

import dataclasses
import itertools
from typing import NamedTuple

from vkc_pin.planning.one_problem import OneProblem
from vkc_pin.planning.outcome import FINAL, charged, joined
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.settings import Settings
from vkc_pin.utils.budget import ENDINGS
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.actions import generate_alternatives, has_open_attachment
from vkc_pin.world.task.actuation import find_shared_coordinate
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.phases import Task
from vkc_pin.world.task.steps import Step
from vkc_pin.world.trajectory.world_model import compute_final_scene

__all__ = ["Stage", "all_at_once", "by_any_attachment", "stages", "step_by_step"]


class Stage(NamedTuple):
    """A step that was planned from where the one before it ends.

    Attributes:
        number: Of the step, from 0.
        one: Its problem.
        plan: What came of it.
    """

    number: int
    one: OneProblem
    plan: Plan


def step_by_step(scene: Scene, task: Task, settings: Settings) -> Plan:
    """Plan every step from where the one before it ends, and join the motions; it ends at the first step that fails.

    Args:
        scene: Robot, objects and obstacles.
        task: What should change in the world.
        settings: How to plan.
    """
    parts = stages(scene, task, settings)
    steps: list[tuple[Step, ...]] = [(step,) for step in task.steps]
    for part in parts:  # one step becomes several where something is taken anew
        steps[part.number] = part.plan.steps
    return joined(scene, list(itertools.chain(*steps)), settings, [part.plan for part in parts])


def all_at_once(scene: Scene, task: Task, settings: Settings) -> Plan:
    """Plan steps as one problem, in which every grasp and every base pose can change in favour of what follows.

    Where that fails, or holds move the same joint, which one chain can have only once, each step is
    planned from where the one before it ends: what that comes to is a motion all the same.

    Args:
        scene: Robot, objects and obstacles.
        task: What should change in the world.
        settings: How to plan.
    """
    if find_shared_coordinate(scene, task.holds) is not None:
        return step_by_step(scene, task, settings)
    if len(task.steps) == 1:
        return by_any_attachment(scene, task, settings)[1]
    result = OneProblem(scene, task, settings).run()
    final = ENDINGS if any(has_open_attachment(scene, step) for step in task.steps) else FINAL
    if result.success or result.status in final:
        return result
    apart = step_by_step(scene, task, settings)
    spent = [result.metrics, apart.metrics]
    return charged(apart if apart.success else result, spent)


def by_any_attachment(scene: Scene, task: Task, settings: Settings) -> tuple[OneProblem, Plan]:
    """Plan a task as one problem; if that fails, by the other attachments that its steps leave open, one after the other.

    What is held and cannot be moved so is let go of and taken anew. Attachments at which no free
    configuration is found for the end of a phase are left aside at once.

    Args:
        scene: Robot, objects and obstacles.
        task: What should change in the world.
        settings: How to plan.

    Returns:
        The problem that was solved, and its plan, whose steps name the attachment unless it is the
        first that will do; if all fail, the first, with what is in the way of the others among the
        notes.
    """
    first = OneProblem(scene, task, settings)
    result = first.run()
    plans, notes = [result], list[str]()
    for name, steps in generate_alternatives(
        scene, task, anew=not settings.terms
    ):  # terms may name phases by their numbers
        if plans[-1].success or plans[-1].status in ENDINGS or first.hindered:
            break
        one = OneProblem(
            scene, compile_task(scene, steps, settings.options), settings, goals_first=True
        )
        plans.append(one.run())
        if plans[-1].success:
            return one, charged(plans[-1], [plan.metrics for plan in plans])
        notes.append(f"at {name}: {next(iter(plans[-1].validation.notes), plans[-1].status)}")
    if len(plans) == 1:
        return first, result
    status = plans[-1].status if plans[-1].status in ENDINGS else result.status
    report = dataclasses.replace(result.validation, notes=(*result.validation.notes, *notes))
    return first, charged(
        dataclasses.replace(result, validation=report, status=status),
        [plan.metrics for plan in plans],
    )


def stages(scene: Scene, task: Task, settings: Settings) -> list[Stage]:
    """Plan every step that changes something from where the one before it ends, up to the first that fails.

    Args:
        scene: Robot, objects and obstacles.
        task: What should change in the world.
        settings: How to plan.
    """
    current, parts = scene, list[Stage]()
    for number, step in enumerate(task.steps):
        # Where a step ends is known only once it is planned; the first begins where all do.
        own = (
            task.truncate(1)
            if not number
            else compile_task(current, [step], settings.options, nothing=True)
        )
        if not own.phases:
            continue
        settings.progress.part(number + 1, 1, len(task.steps))
        one, plan = by_any_attachment(current, own, settings)
        parts.append(Stage(number, one, plan))
        if not plan.success or settings.budget.ended:
            break
        settings.budget.decided += one.checking
        current = compute_final_scene(current, plan.trajectory, one.task.after)
    return parts
