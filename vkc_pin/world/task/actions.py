"""Groups steps into actions, proposes alternative attachments, and checks steps before planning."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.scene.support import find_supports
from vkc_pin.world.task.actuation import check_actuation, find_driving_attachments
from vkc_pin.world.task.compiler import compile_task, make_nothing_to_do_error
from vkc_pin.world.task.phases import Task
from vkc_pin.world.task.steps import Actuate, Grasp, Place, Release, Step, as_steps

__all__ = [
    "compile_each_step",
    "generate_alternatives",
    "group_into_actions",
    "has_open_attachment",
    "list_untried_attachments",
]


def group_into_actions(steps: Sequence[Step]) -> list[tuple[Step, ...]]:
    """Return steps grouped into actions that belong together.

    A grasp is grouped with the step that moves the grasped object, and a release with the step
    before.
    """
    actions: list[tuple[Step, ...]] = []
    for step in steps:
        last = actions[-1] if actions else ()
        grasp = last[-1] if last and isinstance(last[-1], Grasp) else None
        moves_grasped = (
            grasp is not None and isinstance(step, Actuate | Place) and step.object == grasp.object
        )
        if last and (moves_grasped or isinstance(step, Release)):
            actions[-1] = (*last, step)
        else:
            actions.append((step,))
    return actions


def has_open_attachment(scene: Scene, step: Step) -> bool:
    """Return whether a step moves joints of an object by one of several attachments left open.

    That is not so if it keeps the present grasp.
    """
    if not isinstance(step, Actuate) or step.attachment is not None:
        return False
    return len(scene.objects[step.object].object.attachments) > 1 and not _keeps_grasp(scene, step)


def _keeps_grasp(scene: Scene, step: Actuate | Place) -> bool:
    """Return whether the hand moves an object with the grasp in which it holds it at the start."""
    hold = next((hold for hold in scene.holds if hold.object == step.object), None)
    if hold is None or hold.by is not None or step.attachment not in (None, hold.attachment):
        return False
    if isinstance(step, Place):
        return True
    placed = scene.objects[step.object]
    values = {f"{step.object}.{joint}": value for joint, value in step.joints.items()}
    try:
        check_actuation(placed, placed.object.attachments[hold.attachment], {}, values, "steps")
    except InputError:
        return False
    return True


def generate_alternatives(
    scene: Scene, task: Task, *, anew: bool = False
) -> Iterator[tuple[str, tuple[Step, ...]]]:
    """Yield the steps of a task with attachments that it does not use, and "<object>.<attachment>".

    Alternatives exist only if a single step leaves its attachment open; of several such steps, each
    has been planned alone before. An object that is held already may have been grasped where it
    cannot be moved from, or put down; then it is released and grasped again.
    """
    if anew and (again := _regrasp(scene, task.steps[0])):
        named = again[-1]
        yield f"{named.object}.{named.attachment}, grasped again", (*again, *task.steps[1:])
    own = [
        (number, step)
        for number, step in enumerate(task.steps)
        if isinstance(step, Actuate) and has_open_attachment(scene, step)
    ]
    for number, step in own if len(own) == 1 else ():
        used = {hold.attachment for hold in task.holds if hold.object == step.object}
        values = {f"{step.object}.{joint}": value for joint, value in step.joints.items()}
        for name in find_driving_attachments(
            scene.objects[step.object], {}, values, f"steps[{number}]"
        ):
            if name not in used:
                changed = dataclasses.replace(step, attachment=name)
                yield (
                    f"{step.object}.{name}",
                    (*task.steps[:number], changed, *task.steps[number + 1 :]),
                )


def list_untried_attachments(scene: Scene, task: Task) -> list[str]:
    """List attachments of objects that a step grasps at the first one for want of a name.

    They are not tried in its place: some are for tools, others for another use of the object.
    """
    found = []
    for step in task.steps:
        if isinstance(step, Grasp | Place) and step.attachment is None:
            used = {hold.attachment for hold in task.holds if hold.object == step.object}
            others = [
                f"{step.object}.{name}"
                for name in scene.objects[step.object].object.attachments
                if name not in used
            ]
            if others and step.object not in scene.held:
                found.append(f"at {', '.join(others)}: not tried, since the step names none")
    return list(dict.fromkeys(found))


def _regrasp(scene: Scene, step: Step) -> tuple[Release, Actuate | Place] | None:
    """Return steps that release the held object, grasp it again and move it; None if impossible.

    A free object is released only if it rests on a support.
    """
    if not isinstance(step, Actuate | Place) or not _keeps_grasp(scene, step):
        return None
    placed = scene.objects[step.object]
    if placed.object.free and not find_supports(placed, _list_resting_shapes(scene)):
        return None
    return Release(step.object), dataclasses.replace(step, attachment=scene.held[step.object])


def _list_resting_shapes(scene: Scene) -> list[tuple[str, pin.GeometryObject]]:
    """Return label and shape of all objects and obstacles in the scene that are not held."""
    others = [(name, other) for name, other in scene.objects.items() if name not in scene.held]
    shapes = [(name, shape) for name, other in others for shape in make_world_shapes(other)]
    return [*shapes, *zip(scene.obstacle_labels, scene.obstacles, strict=True)]


def compile_each_step(scene: Scene, steps: Sequence[Step], options: Options) -> list[Task]:
    """Compile each step alone, in the scene that the steps before should lead to.

    This checks that every step is feasible in its place, as far as that does not depend on motions.

    Returns:
        Task of each step.
    """
    tasks: list[Task] = []
    for number, step in enumerate(as_steps(steps)):
        tasks.append(compile_task(scene, [step], options, nothing=True, first=number))
        scene = _predict_scene_after(scene, tasks[-1])
    if not any(task.phases for task in tasks):
        raise make_nothing_to_do_error()
    return tasks


def _predict_scene_after(scene: Scene, task: Task) -> Scene:
    """Return the scene in which a task should end.

    Released objects without a goal are at the placement that they had before.
    """
    scene = scene.with_held({})
    for phase in task.phases:
        for coordinate, value in phase.values.items():
            name, _, joint = coordinate.partition(".")
            item = scene.objects[name].object
            index = item.coordinates.index(joint)
            scene = scene.with_state(
                name, {joint: float(np.clip(value, item.lower[index], item.upper[index]))}
            )
        for hold, placement in phase.lowered.items():
            scene = scene.with_placement(hold.object, placement)
    return scene.with_held(task.after)
