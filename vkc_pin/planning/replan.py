"""Plans the rest of a motion again, in the world as it is now."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from vkc_pin.errors import InputError
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.planner import Planner
from vkc_pin.planning.prepare import prepare
from vkc_pin.utils.arguments import (
    check_choice,
    check_finite_array,
    check_instance,
)
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.actions import compile_each_step
from vkc_pin.world.task.steps import Step
from vkc_pin.world.trajectory.splicing import extract_times
from vkc_pin.world.trajectory.world_model import find_phase_at

# [m], [rad] between a measured and an assumed grasp: half of what validation accepts
_SAME_GRASP = 5e-4


def replan(
    plan: Plan,
    time: float,
    *,
    state: ArrayLike | None = None,
    velocity: ArrayLike | Mapping[str, float] | None = None,
    scene: Scene | None = None,
    time_limit: float | None = None,
    planner: Planner | None = None,
) -> Plan:
    """Plan the rest of a plan's motion again, from a moment on, to the same goals.

    Steps that are over at that time are dropped. The search starts from the rest of the plan's
    motion; if that fails, the usual search follows until the time limit. The new motion begins with
    the velocity of the old one, so that the two are one smooth motion, within all limits.

    Args:
        plan: A successful plan.
        time: Time of its motion at which the new one takes over [s].
        state: Measured configuration of the robot at that time, shape (n,), with headings and
            continuous joints of any turn. Default: the scene's.
        velocity: Measured velocity of the robot, shape (n,), [m/s] and [rad/s], or coordinate →
            velocity. Default: the scene's.
        scene: The world at that time: `plan.scene_at(time)`, with measured placements.
            Default: that scene itself. If an object that the hand holds is elsewhere than planned,
            its grasp counts as measured there.
        time_limit: Wall-clock limit [s]; see `plan`. If there is one, a failure is not explained,
            which may take longer.
        planner: Planner whose caches are used.

    Returns:
        The plan of the remaining steps; its motion counts from 0. As of `plan`, it may be a
        failure: then `plan.stop(time)` stops.

    Raises:
        InputError: The plan is no success, the time is outside its motion or after all its steps,
            the scene is of another robot or lacks an object, or the state is invalid.
    """
    check_instance(plan, Plan, "plan").check_success()
    time = plan.check_time(time)
    steps = find_remaining_steps(plan, time)
    now = plan.scene_at(time) if scene is None else _check_scene(plan, scene)
    if state is not None:
        values = check_finite_array(state, "state")
        if values.shape != now.start.shape:
            raise InputError(
                "wrong shape", field="state", expected=now.start.shape, got=values.shape
            )
        values = now.robot.unwrap(values, now.start)
        now = now.with_start(base=values[:3], arm=values[3:])
    if velocity is not None:
        now = now.with_start(velocity=velocity)
    now = measure_grasps(now)
    motion = plan.trajectory
    rest = extract_times(motion, time, float(motion.times[-1]))
    prepared = prepare(now, steps, options=plan.options, terms=plan.terms, planner=planner)
    return prepared.solve(
        guess=rest, time_limit=time_limit, seed=plan.seed, explain=time_limit is None
    )


def _check_scene(plan: Plan, scene: Scene) -> Scene:
    """Return a scene in which the steps of a plan can go on. Raises `InputError`."""
    check_instance(scene, Scene, "scene")
    robot = plan.scene.robot
    if scene.robot.coordinates.names != robot.coordinates.names:
        raise InputError(
            "another robot", field="scene.robot", expected=robot.name, got=scene.robot.name
        )
    for name in plan.scene.objects:
        check_choice(name, scene.objects, "object", "scene.objects")
    return scene


def measure_grasps(scene: Scene) -> Scene:
    """Return a scene in which objects that are fixed in the world are held where the hand is.

    Grasps that fit to within `_SAME_GRASP` are left as they are.

    Raises:
        InputError: An object is too far from the hand that holds it.
    """
    for hold in scene.holds:
        if hold.by is not None or scene.objects[hold.object].object.free:
            continue
        measured = scene.with_measured_grasp(hold.object)
        (new,) = [other for other in measured.holds if other.object == hold.object]
        none = (0.0,) * 6
        change = np.subtract(new.deviation or none, hold.deviation or none)
        if np.abs(change).max() > _SAME_GRASP:
            scene = measured
    return scene


def find_remaining_steps(plan: Plan, time: float) -> tuple[Step, ...]:
    """Return the steps that are not over at a time of a plan's motion [s].

    A step is over at the end of its last phase, and one without phases, such as a release, when the
    phase after it has begun. Phases of steps and of the motion are matched by their names.

    Raises:
        InputError: All steps are over.
    """
    motion = plan.trajectory
    if time >= motion.times[-1]:
        problem, expected = "all steps are over then", "a time before the end of the motion"
        raise InputError(problem, field="time", expected=expected, got=time)
    phases = motion.phases
    current = phases.index(find_phase_at(motion, time))
    done = 0
    end = 0  # number of the motion's phases until the end of a step
    for task in compile_each_step(plan.scene, plan.steps, plan.options):
        first = 0
        for boundary in task.boundaries:
            begin = end
            for phase in task.phases[first : boundary.phases]:
                names = [span.name for span in phases[end:]]
                if phase.name in names:
                    end += names.index(phase.name) + 1
            first = boundary.phases
            is_over = end <= current
            if end > begin:
                is_over = time >= motion.times[phases[end - 1].last]
            if not is_over:
                return plan.steps[done:]
            done += 1
    return plan.steps[-1:]
