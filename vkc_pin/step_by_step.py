"""Steps one after the other, each without a thought of the next: what planning them as one problem is compared with."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence

from vkc_pin.goal import compile_task
from vkc_pin.interrupt import interruptible
from vkc_pin.one_problem import OneProblem, Settings
from vkc_pin.plan import Plan
from vkc_pin.scene import Scene
from vkc_pin.standing import TIMES, standing
from vkc_pin.steps import Step
from vkc_pin.trajectory import join
from vkc_pin.validation import validate
from vkc_pin.world import scene_after

__all__ = ["joined", "stages", "step_by_step", "summed"]

_ROUNDS = 10  # of the solver from one seed: what takes more has mostly run into a dead end


def step_by_step(scene: Scene, steps: Sequence[Step], settings: Settings) -> Plan:
    """Plan every step from where the one before it ends, and join the motions; it ends at the first step that fails.

    Args:
        scene: Robot, objects and obstacles.
        steps: What should change in the world.
        settings: How to plan; the time limit is for all steps together.
    """
    compile_task(scene, steps, settings.options)  # what is wrong with the list as a whole is said before anything is planned
    return joined(scene, steps, settings, [plan for _, plan in stages(scene, steps, settings)])


def stages(scene: Scene, steps: Sequence[Step], settings: Settings, *, brief: bool = False) -> list[tuple[OneProblem, Plan]]:
    """Plan every step that changes something from where the one before it ends, up to the first that fails, or to Ctrl-C.

    Args:
        scene: Robot, objects and obstacles.
        steps: What should change in the world.
        settings: How to plan; the time limit is for all steps together.
        brief: Whether the motions are to be planned as one afterwards. Then they are rough, and all but the first step are given
            up soon: where the next cannot be done from where a step led, all seeds fail.
    """
    options = dataclasses.replace(settings.options, max_restarts=1, max_outer=min(settings.options.max_outer, _ROUNDS))
    settings = dataclasses.replace(settings, rough=True) if brief else settings
    current, spent = scene, 0.0
    parts: list[tuple[OneProblem, Plan]] = []
    try:
        for number, step in enumerate(steps, start=1):
            if not compile_task(current, [step], settings.options, nothing=True).phases:
                continue
            left = None if settings.time_limit is None else max(settings.time_limit - spent, 1e-3)
            chosen = options if brief and parts else settings.options
            settings.progress.part(number, 1, len(steps))
            one = OneProblem(current, [step], dataclasses.replace(settings, options=chosen, time_limit=left))
            parts.append((one, one.run()))
            if not parts[-1][1].success or settings.interrupt.pressed:
                break
            spent += parts[-1][1].metrics["planning_time"]
            current = scene_after(current, parts[-1][1].trajectory, one.task.after)
    except KeyboardInterrupt:
        settings.interrupt.pressed = True
    return parts


def joined(scene: Scene, steps: Sequence[Step], settings: Settings, parts: Sequence[Plan]) -> Plan:
    """Return the plans of steps, one after the other, as one plan of all `steps`; where nothing was begun, nothing moves."""
    if not parts:
        return standing(scene, steps, settings.options, seed=settings.seed, terms=settings.terms)
    settings.progress.doing("checking all of it")
    with interruptible() as interrupt:
        trajectory = join([part.trajectory for part in parts], pause=settings.options.grasp_time)
        checked = time.perf_counter()
        report = validate(scene, steps, trajectory, settings.options, settings.terms)
    settings.interrupt.pressed |= interrupt.pressed
    status = "interrupted" if settings.interrupt.pressed else "rejected" if parts[-1].success else parts[-1].status
    report = dataclasses.replace(report, notes=parts[-1].validation.notes)
    spent = time.perf_counter() - checked
    metrics = summed([part.metrics for part in parts])
    metrics["planning_time"] += spent
    metrics["time_validation"] += spent
    metrics |= {**trajectory.metrics(), "clearance": report.clearance, "closure_error": report.closure_error}
    return Plan(
        scene=scene,
        steps=tuple(steps),
        options=settings.options,
        trajectory=trajectory,
        validation=report,
        status="success" if report.ok else status,
        metrics=metrics,
        seed=settings.seed,
        initialization=", ".join(part.initialization for part in parts),
        history=tuple(row for part in parts for row in part.history),
        terms=settings.terms,
    )


def summed(metrics: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return what several plans took: times, iterations and rounds."""
    keys = ("planning_time", "build_time", "iterations", "rounds", *(f"time_{key}" for key in TIMES))
    return {key: sum(part[key] for part in metrics) for key in keys}
