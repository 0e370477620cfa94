"""Steps one after the other, each without a thought of the next: what planning them as one problem is compared with."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence

import numpy as np

from vkc_pin.goal import compile_task
from vkc_pin.hold import as_mappings
from vkc_pin.one_problem import TIMES, OneProblem, Settings
from vkc_pin.plan import Plan
from vkc_pin.scene import Scene
from vkc_pin.steps import Step
from vkc_pin.task import Task
from vkc_pin.trajectory import Trajectory, join
from vkc_pin.validation import validate
from vkc_pin.world import World

__all__ = ["joined", "scene_after", "stages", "step_by_step", "summed"]


def step_by_step(scene: Scene, steps: Sequence[Step], settings: Settings) -> Plan:
    """Plan every step from where the one before it ends, and join the motions; it ends at the first step that fails.

    Args:
        scene: Robot, objects and obstacles.
        steps: What should change in the world.
        settings: How to plan; the time limit is for all steps together.
    """
    compile_task(scene, steps, settings.options)  # what is wrong with the list as a whole is said before anything is planned
    return joined(scene, steps, settings, [plan for _, plan in stages(scene, steps, settings)])


def stages(scene: Scene, steps: Sequence[Step], settings: Settings) -> list[tuple[OneProblem, Plan]]:
    """Plan every step that changes something from where the one before it ends, up to the first that fails."""
    current, spent = scene, 0.0
    parts: list[tuple[OneProblem, Plan]] = []
    for step in steps:
        if not compile_task(current, [step], settings.options, nothing=True).phases:
            continue
        left = None if settings.time_limit is None else max(settings.time_limit - spent, 1e-3)
        one = OneProblem(current, [step], dataclasses.replace(settings, time_limit=left))
        parts.append((one, one.run()))
        if not parts[-1][1].success:
            break
        spent += parts[-1][1].metrics["planning_time"]
        current = scene_after(current, one.task, parts[-1][1].trajectory)
    return parts


def joined(scene: Scene, steps: Sequence[Step], settings: Settings, parts: Sequence[Plan]) -> Plan:
    """Return the plans of steps, one after the other, as one plan of all `steps`."""
    trajectory = join([part.trajectory for part in parts], pause=settings.options.grasp_time)
    checked = time.perf_counter()
    report = validate(scene, steps, trajectory, settings.options)
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
        status="success" if report.ok else "rejected" if parts[-1].success else parts[-1].status,
        metrics=metrics,
        seed=settings.seed,
        initialization=", ".join(part.initialization for part in parts),
        history=tuple(row for part in parts for row in part.history),
    )


def summed(metrics: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return what several plans took: times, iterations and rounds."""
    keys = ("planning_time", "build_time", "iterations", "rounds", *(f"time_{key}" for key in TIMES))
    return {key: sum(part[key] for part in metrics) for key in keys}


def scene_after(scene: Scene, task: Task, trajectory: Trajectory) -> Scene:
    """Return the scene at the end of a motion: where robot and objects are, and what is held.

    Args:
        scene: The scene at its start.
        task: What the motion brings about.
        trajectory: The motion.
    """
    world, names = World(scene), trajectory.names
    last = dict(zip(names, trajectory.positions[-1].tolist(), strict=True))
    robot = np.clip(trajectory.positions[-1, : trajectory.robot_size], scene.robot.lower, scene.robot.upper)
    robot[:2] = np.clip(robot[:2], scene.arena[::2], scene.arena[1::2])
    after = scene.with_held({}).with_start(base=robot[:3], arm=robot[3:])
    (row,) = world.positions(trajectory, trajectory.times[-1:])
    for name, placed in scene.objects.items():
        if placed.object.free:
            after = after.with_placement(name, world.placement(name, row))
        joints = [joint for joint in placed.object.coordinates.names if f"{name}.{joint}" in last]
        limits = {joint: placed.object.coordinates.index(joint) for joint in joints}
        state = {
            joint: float(np.clip(last[f"{name}.{joint}"], placed.object.lower[i], placed.object.upper[i]))
            for joint, i in limits.items()
        }
        after = after.with_state(name, state) if state else after
    held, by = as_mappings(task.after)
    at = {}
    for name, attachment in held.items():
        freedoms = zip(
            after.objects[name].object.attachment(attachment).coordinates,
            after.objects[name].object.attachment(attachment).freedoms,
            strict=True,
        )
        at[name] = [float(np.clip(last[f"{name}.{c}"], freedom.lower, freedom.upper)) for c, freedom in freedoms]
    return after.with_held(held, by=by, at={name: values for name, values in at.items() if values})
