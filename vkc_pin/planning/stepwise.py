"""Steps one after the other: for their own sake, or as the start of one problem of all of them."""

from __future__ import annotations

import dataclasses

from vkc_pin.motion.world import scene_after
from vkc_pin.planning.one_problem import OneProblem
from vkc_pin.planning.outcome import charged, joined
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.settings import Settings
from vkc_pin.scene.scene import Scene
from vkc_pin.seeds.seed import seed_of
from vkc_pin.task.compiler import compile_task
from vkc_pin.task.phases import Task

__all__ = ["all_at_once", "stages", "step_by_step"]

_SOLVER_ROUNDS = 10  # of the solver from one seed: what takes more has mostly run into a dead end


def step_by_step(scene: Scene, task: Task, settings: Settings) -> Plan:
    """Plan every step from where the one before it ends, and join the motions; it ends at the first step that fails.

    Args:
        scene: Robot, objects and obstacles.
        task: What should change in the world.
        settings: How to plan; the time limit is for all steps together.
    """
    return joined(scene, task.steps, settings, [plan for _, plan in stages(scene, task, settings)])


def all_at_once(scene: Scene, task: Task, settings: Settings) -> Plan:
    """Plan steps as one problem.

    First each step from where the one before it ends: small problems, quickly solved. What comes out starts the whole
    problem, in which every grasp and every base pose can still change in favour of what follows. Where a step fails, since
    the ones before it led to where it cannot be done, the whole problem starts from seeds that were searched for with all
    steps in mind.

    Args:
        scene: Robot, objects and obstacles.
        task: What should change in the world.
        settings: How to plan.
    """
    if len(task.steps) == 1:
        return OneProblem(scene, task, settings).run()
    parts = stages(scene, task, settings, brief=True)
    plans = [plan for _, plan in parts]
    if settings.interrupt.pressed:
        return joined(scene, task.steps, settings, plans)
    settings.progress.part(1, len(task.steps), len(task.steps))
    if len(parts) == 1 and len(task.phases) == len(parts[0][0].task.phases):  # the other steps change nothing
        return OneProblem(scene, task, settings).run()
    if settings.initialization == "stationary" and not plans[-1].success:
        # A stationary seed knows nothing of the steps: for all of them it is no better than for the one that failed.
        return joined(scene, task.steps, settings, plans)
    spent = [plan.metrics for plan in plans]
    result = plans[-1]
    if result.success:
        pieces = [one.piece() for one, _ in parts]
        result = OneProblem(scene, task, settings.after(spent)).run(lambda problem: seed_of(problem, pieces))
        spent.append(result.metrics)
        if not result.success:  # what the steps came to on their own is a motion all the same
            apart = joined(scene, task.steps, settings, plans)
            spent = [apart.metrics, spent[-1]]
            result = apart if apart.success else result
    if not result.success and not settings.interrupt.pressed:
        result = OneProblem(scene, task, settings.after(spent)).run()
        spent.append(result.metrics)
    return charged(result, spent)


def stages(scene: Scene, task: Task, settings: Settings, *, brief: bool = False) -> list[tuple[OneProblem, Plan]]:
    """Plan every step that changes something from where the one before it ends, up to the first that fails, or to Ctrl-C.

    Args:
        scene: Robot, objects and obstacles.
        task: What should change in the world.
        settings: How to plan; the time limit is for all steps together.
        brief: Whether the motions are to be planned as one afterwards. Then they are rough, and all but the first step are given
            up soon: where the next cannot be done from where a step led, all seeds fail.
    """
    options = dataclasses.replace(settings.options, max_restarts=1, max_outer=min(settings.options.max_outer, _SOLVER_ROUNDS))
    settings = dataclasses.replace(settings, rough=True) if brief else settings
    current = scene
    parts: list[tuple[OneProblem, Plan]] = []
    for number, step in enumerate(task.steps, start=1):
        # Where a step ends is known only once it is planned; the first begins where all do.
        own = task.until(1) if number == 1 else compile_task(current, [step], settings.options, nothing=True)
        if not own.phases:
            continue
        chosen = dataclasses.replace(settings, options=options) if brief and parts else settings
        settings.progress.part(number, 1, len(task.steps))
        one = OneProblem(current, own, chosen.after(plan.metrics for _, plan in parts))
        parts.append((one, one.run()))
        if not parts[-1][1].success or settings.interrupt.pressed:
            break
        current = scene_after(current, parts[-1][1].trajectory, own.after)
    return parts
