"""Several steps as one problem, from a seed in which each step was planned on its own."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from vkc_pin.one_problem import OneProblem, Settings
from vkc_pin.plan import Plan
from vkc_pin.scene import Scene
from vkc_pin.seed import seed_of
from vkc_pin.step_by_step import joined, stages, summed
from vkc_pin.steps import Step

__all__ = ["all_at_once"]


def all_at_once(scene: Scene, steps: Sequence[Step], settings: Settings) -> Plan:
    """Plan steps as one problem.

    First each step from where the one before it ends: small problems, quickly solved. What comes out starts the whole
    problem, in which every grasp and every base pose can still change in favour of what follows. Where a step fails, since
    the ones before it led to where it cannot be done, the whole problem starts from seeds that were searched for with all
    steps in mind.

    Args:
        scene: Robot, objects and obstacles.
        steps: What should change in the world.
        settings: How to plan.
    """
    whole = OneProblem(scene, steps, settings)
    if len(whole.task.steps) == 1:
        return whole.run()
    parts = stages(scene, whole.task.steps, settings, brief=True)
    plans = [plan for _, plan in parts]
    if settings.interrupt.pressed:
        return joined(scene, whole.task.steps, settings, plans)
    try:
        return _whole(scene, steps, settings, whole, parts)
    except KeyboardInterrupt:
        settings.interrupt.pressed = True
        return joined(scene, whole.task.steps, settings, plans)


def _whole(
    scene: Scene, steps: Sequence[Step], settings: Settings, whole: OneProblem, parts: Sequence[tuple[OneProblem, Plan]]
) -> Plan:
    """Return the plan of all steps, from what came out of each."""
    plans = [plan for _, plan in parts]
    settings.progress.part(1, len(whole.task.steps), len(whole.task.steps))
    if len(parts) == 1 and len(whole.task.phases) == len(parts[0][0].task.phases):  # the other steps change nothing
        return whole.run()
    # A stationary seed knows nothing of the steps: for all of them it is no better than for the one that failed.
    hopeless = settings.initialization == "stationary" and not plans[-1].success
    if hopeless:
        return joined(scene, whole.task.steps, settings, plans)
    spent = [plan.metrics for plan in plans]
    result = plans[-1]
    if result.success:
        pieces = [one.piece() for one, _ in parts]
        result = OneProblem(scene, steps, _left(settings, spent)).run(lambda problem: seed_of(problem, pieces))
        spent.append(result.metrics)
        if not result.success:  # what the steps came to on their own is a motion all the same
            apart = joined(scene, whole.task.steps, settings, plans)
            spent = [apart.metrics, spent[-1]]
            result = apart if apart.success else result
    if not result.success and not settings.interrupt.pressed:
        result = OneProblem(scene, steps, _left(settings, spent)).run()
        spent.append(result.metrics)
    return dataclasses.replace(result, metrics={**result.metrics, **summed(spent)})


def _left(settings: Settings, spent: Sequence[Mapping[str, float]]) -> Settings:
    """Return the settings with what is left of the time limit."""
    if settings.time_limit is None:
        return settings
    used = sum(metrics["planning_time"] for metrics in spent)
    return dataclasses.replace(settings, time_limit=max(settings.time_limit - used, 1e-3))
