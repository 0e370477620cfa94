"""Steps all at once, or one after the other."""

from __future__ import annotations

from vkc_pin.motion.world import scene_after
from vkc_pin.planning.one_problem import OneProblem
from vkc_pin.planning.outcome import FINAL, charged, joined
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.settings import Settings
from vkc_pin.scene.scene import Scene
from vkc_pin.task.compiler import compile_task
from vkc_pin.task.phases import Task

__all__ = ["all_at_once", "stages", "step_by_step"]


def step_by_step(scene: Scene, task: Task, settings: Settings) -> Plan:
    """Plan every step from where the one before it ends, and join the motions; it ends at the first step that fails.

    Args:
        scene: Robot, objects and obstacles.
        task: What should change in the world.
        settings: How to plan.
    """
    return joined(scene, task.steps, settings, [plan for _, plan in stages(scene, task, settings)])


def all_at_once(scene: Scene, task: Task, settings: Settings) -> Plan:
    """Plan steps as one problem, in which every grasp and every base pose can change in favour of what follows.

    Where that fails, each step is planned from where the one before it ends: what that comes to is a motion all the same.

    Args:
        scene: Robot, objects and obstacles.
        task: What should change in the world.
        settings: How to plan.
    """
    result = OneProblem(scene, task, settings).run()
    if result.success or len(task.steps) == 1 or result.status in FINAL:
        return result
    apart = step_by_step(scene, task, settings)
    spent = [result.metrics, apart.metrics]
    return charged(apart if apart.success else result, spent)


def stages(scene: Scene, task: Task, settings: Settings) -> list[tuple[OneProblem, Plan]]:
    """Plan every step that changes something from where the one before it ends, up to the first that fails.

    Args:
        scene: Robot, objects and obstacles.
        task: What should change in the world.
        settings: How to plan.
    """
    current = scene
    parts: list[tuple[OneProblem, Plan]] = []
    for number, step in enumerate(task.steps, start=1):
        # Where a step ends is known only once it is planned; the first begins where all do.
        own = task.until(1) if number == 1 else compile_task(current, [step], settings.options, nothing=True)
        if not own.phases:
            continue
        settings.progress.part(number, 1, len(task.steps))
        one = OneProblem(current, own, settings)
        parts.append((one, one.run()))
        if not parts[-1][1].success or settings.budget.ended:
            break
        settings.budget.decided += one.checking
        current = scene_after(current, parts[-1][1].trajectory, own.after)
    return parts
