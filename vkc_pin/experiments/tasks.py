"""Lists the tasks of all experiments, each from random starts."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from vkc_pin.experiments import door, door_and_drawer, household, initialization
from vkc_pin.experiments.comparison import Assignment, place_objects
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Actuate, Grasp, Touch

TASKS: Mapping[str, Assignment] = {
    "door": Assignment("door", (Actuate("door", door.GOAL),), "open a door"),
    "drawer": Assignment("drawer", (Actuate("drawer", {"slide": 0.3}),), "pull a drawer"),
    **{
        scene: Assignment(
            scene,
            (Grasp("stick"), Touch("stick.tip", initialization.TARGET)),
            "touch a cube with a stick",
        )
        for scene in initialization.SCENES
    },
    **{task.scene: task for task in door_and_drawer.TASKS.values()},
    **{f"household_{name}": task for name, task in household.TASKS.items()},
}
"""The experiments' tasks by name: those of the paper, and the two scenes beside."""


def make_start(task: str, seed: int, number: int) -> Scene:
    """Return a task's scene with random start `number`, and scattered objects if there are any."""
    rng = np.random.default_rng([seed, list(TASKS).index(task), number])
    own, scene = TASKS[task], load_scene(TASKS[task].scene)
    scattered = place_objects(scene, {"placed": own.scatter(scene, rng)}) if own.scatter else scene
    return scattered.sample_start(rng)
