"""What steps come to before anything is planned: actions, what they leave open, and what cannot be done at its place."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from vkc_pin.options import Options
from vkc_pin.scene.scene import Scene
from vkc_pin.task.compiler import compile_task, nothing_to_do
from vkc_pin.task.handling import driving
from vkc_pin.task.phases import Task
from vkc_pin.task.steps import Actuate, Grasp, Place, Release, Step, as_list

__all__ = ["actions_of", "alternatives", "foresee", "is_open"]


def actions_of(steps: Sequence[Step]) -> list[tuple[Step, ...]]:
    """Return steps by what is done together: a grasp with what comes of it, and letting go with what came before."""
    actions: list[tuple[Step, ...]] = []
    for step in steps:
        last = actions[-1] if actions else ()
        grasp = last[-1] if last and isinstance(last[-1], Grasp) else None
        taken = grasp is not None and isinstance(step, Actuate | Place) and step.object == grasp.object
        if last and (taken or isinstance(step, Release)):
            actions[-1] = (*last, step)
        else:
            actions.append((step,))
    return actions


def is_open(scene: Scene, step: Step) -> bool:
    """Return whether a step moves joints of what is not held yet, and leaves open by which of several attachments."""
    if not isinstance(step, Actuate) or step.attachment is not None or step.object in scene.held:
        return False
    return len(scene.objects[step.object].object.attachments) > 1


def alternatives(scene: Scene, task: Task, *, anew: bool = False) -> Iterator[tuple[str, tuple[Step, ...]]]:
    """Yield the steps of a task by attachments that it does not use, each with "<object>.<attachment>".

    There are some only where a single one of its steps leaves that open: of several, each is planned alone before. What is held
    already may have been grasped where it cannot be moved from: then it is let go of, and taken anew.

    Args:
        scene: Where the task begins.
        task: What its steps come to if nobody says otherwise.
        anew: Whether something may be taken anew, which makes more phases.
    """
    first = task.steps[0]
    held = scene.held.get(first.object) if isinstance(first, Actuate) else None
    if anew and isinstance(first, Actuate) and held is not None and first.attachment in (None, held):
        steps = (Release(first.object), dataclasses.replace(first, attachment=held), *task.steps[1:])
        yield f"{first.object}.{held}, taken anew", steps
    own = [(number, step) for number, step in enumerate(task.steps) if isinstance(step, Actuate) and is_open(scene, step)]
    for number, step in own if len(own) == 1 else ():
        used = {hold.attachment for hold in task.holds if hold.object == step.object}
        values = {f"{step.object}.{joint}": value for joint, value in step.joints.items()}
        for name in driving(scene.objects[step.object], {}, values, f"steps[{number}]"):
            if name not in used:
                changed = dataclasses.replace(step, attachment=name)
                yield f"{step.object}.{name}", (*task.steps[:number], changed, *task.steps[number + 1 :])


def foresee(scene: Scene, steps: Sequence[Step], options: Options) -> list[Task]:
    """Check that every step can be done at its place, as far as that does not depend on motions; return what each asks for.

    Raises:
        InputError: It cannot; the error names the first such step.
    """
    tasks: list[Task] = []
    for number, step in enumerate(as_list(steps)):
        tasks.append(compile_task(scene, [step], options, nothing=True, first=number))
        scene = _ideally_after(scene, tasks[-1])
    if not any(task.phases for task in tasks):
        raise nothing_to_do()
    return tasks


def _ideally_after(scene: Scene, task: Task) -> Scene:
    """Return the scene in which a task ends if all goes as it says; what it leaves somewhere stands where it stood."""
    scene = scene.with_held({})
    for phase in task.phases:
        for coordinate, value in phase.values.items():
            name, _, joint = coordinate.partition(".")
            thing = scene.objects[name].object
            index = thing.coordinates.index(joint)
            scene = scene.with_state(name, {joint: float(np.clip(value, thing.lower[index], thing.upper[index]))})
        for hold, placement in phase.lowered.items():
            scene = scene.with_placement(hold.object, placement)
    return scene.with_held(task.after)
