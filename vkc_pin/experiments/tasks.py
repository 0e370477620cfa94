"""Lists the tasks of all experiments, each from random starts."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from vkc_pin.experiments import door, door_and_drawer, household, initialization
from vkc_pin.experiments.comparison import Assignment, place_objects
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Actuate, Grasp, Touch

_TOUCH = (Grasp("stick"), Touch("stick.tip", initialization.TARGET))


def _list_tasks() -> dict[str, Assignment]:
    tasks = {
        "door": Assignment("door", (Actuate("door", door.GOAL),), "open a door"),
        "drawer": Assignment("drawer", (Actuate("drawer", {"slide": 0.3}),), "pull a drawer"),
    }
    for scene in initialization.SCENES:
        tasks[scene] = Assignment(scene, _TOUCH, "touch a cube with a stick")
    for task in door_and_drawer.TASKS.values():
        tasks[task.scene] = task
    for name, task in household.TASKS.items():
        tasks[f"household_{name}"] = task
    return tasks


TASKS: Mapping[str, Assignment] = _list_tasks()
"""The experiments' tasks by name: those of the paper, and the two scenes beside."""


def make_start(task: str, seed: int, number: int) -> Scene:
    """Return a task's scene with random start `number`, and scattered objects if there are any."""
    rng = np.random.default_rng([seed, list(TASKS).index(task), number])
    assignment = TASKS[task]
    scene = load_scene(assignment.scene)
    if assignment.scatter:
        scene = place_objects(scene, {"placed": assignment.scatter(scene, rng)})
    return scene.sample_start(rng)
