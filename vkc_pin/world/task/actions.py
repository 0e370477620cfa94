"""Groups steps into actions, proposes alternative attachments, and checks steps before planning."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator, Sequence

import numpy as np
import pinocchio as pin

from vkc_pin.options import Options
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.scene.support import find_supports
from vkc_pin.world.task.compiler import compile_task, make_nothing_to_do_error
from vkc_pin.world.task.phases import Task
from vkc_pin.world.task.steps import Actuate, Grasp, Place, Release, Step, Touch, as_steps


def group_into_actions(steps: Sequence[Step]) -> list[tuple[Step, ...]]:
    """Return steps grouped into actions that belong together.

    A grasp is grouped with the step that moves the grasped object, and a release with the step
    before.
    """
    actions: list[tuple[Step, ...]] = []
    for step in steps:
        if actions and _belongs_to(step, actions[-1][-1]):
            actions[-1] = (*actions[-1], step)
        else:
            actions.append((step,))
    return actions


def _belongs_to(step: Step, before: Step) -> bool:
    """Return whether a step belongs to the action of the step before."""
    if isinstance(step, Release):
        return True
    if isinstance(before, Grasp) and isinstance(step, Actuate | Place):
        return step.object == before.object
    return False


def generate_alternatives(task: Task) -> Iterator[tuple[str, tuple[Step, ...]]]:
    """Yield "<object>.<attachment>" and the steps of a task with each attachment it leaves open.

    Alternatives exist only if a single grasp of the task is open; of several such grasps, each has
    been planned alone before.
    """
    if len(task.open_attachments) == 1:
        (grasp,) = task.open_attachments
        before = task.steps[: grasp.step]
        step = task.steps[grasp.step]
        after = task.steps[grasp.step + 1 :]
        for name in grasp.others:
            yield f"{grasp.object}.{name}", (*before, _name_attachment(step, name), *after)


def generate_regrasps(
    scene: Scene, task: Task, options: Options, named: Collection[str] = ()
) -> Iterator[tuple[str, tuple[Step, ...]]]:
    """Yield steps that release an object held at the start and grasp it again for a step.

    An object that is held already may have been grasped where it cannot be moved from, or put down.
    It is grasped where it was, or else at another attachment that the step leaves open. A free
    object is released only if it rests on a support.

    Args:
        scene: Scene in which the task starts.
        task: Task of a single step. Nothing is yielded unless it moves an object held at the start.
        options: Options of planning.
        named: Objects that are held where the user wants them to be.
    """
    (step,) = task.steps
    name = get_grasped_object(step)
    holds = [hold for hold in task.phases[0].held if hold.object == name]
    if not holds:
        return
    hold = holds[0]
    if hold.by is not None:
        return
    placed = scene.objects[hold.object]
    if placed.object.free and not find_supports(placed, _list_resting_shapes(scene)):
        return
    release = Release(hold.object)
    again = _name_attachment(step, hold.attachment)
    yield f"{hold.object}.{hold.attachment}, grasped again", (release, again)
    if hold.object not in named:
        yield from generate_alternatives(compile_task(scene, (release, step), options))


def get_grasped_object(step: Step) -> str | None:
    """Return the object that a step grasps unless it is held; None for other steps."""
    if isinstance(step, Touch):
        owner, dot, _ = step.frame.partition(".")
        return owner if dot else None
    return step.object if isinstance(step, Actuate | Grasp | Place) else None


def _name_attachment(step: Step, name: str) -> Step:
    """Return a step that grasps, with the name of its attachment."""
    assert isinstance(step, Actuate | Grasp | Place | Touch)
    return dataclasses.replace(step, attachment=name)


def _list_resting_shapes(scene: Scene) -> list[tuple[str, pin.GeometryObject]]:
    """Return label and shape of all objects and obstacles in the scene that are not held."""
    shapes = list[tuple[str, pin.GeometryObject]]()
    for name, placed in scene.objects.items():
        if name not in scene.held:
            shapes += [(name, shape) for shape in make_world_shapes(placed)]
    shapes += zip(scene.obstacle_labels, scene.obstacles, strict=True)
    return shapes


def compile_each_step(scene: Scene, steps: Sequence[Step], options: Options) -> list[Task]:
    """Compile each step alone, in the scene that the steps before should lead to.

    This checks that every step is feasible in its place, as far as that does not depend on motions.

    Returns:
        Task of each step.
    """
    tasks: list[Task] = []
    for number, step in enumerate(as_steps(steps)):
        task = compile_task(scene, [step], options, nothing=True, first=number)
        tasks.append(task)
        scene = _predict_scene_after(scene, task)
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
            reached = float(np.clip(value, item.lower[index], item.upper[index]))
            scene = scene.with_state(name, {joint: reached})
        for hold, placement in phase.lowered.items():
            scene = scene.with_placement(hold.object, placement)
    return scene.with_held(task.after)
