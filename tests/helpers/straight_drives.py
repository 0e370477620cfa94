"""Makes problems of straight drives."""

from __future__ import annotations

import numpy as np

from helpers.drives import drive_through, move_start
from helpers.small_problems import make_program
from vkc_pin.options import Options
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import GoTo


def make_straight_drive(
    scene: Scene, options: Options, **goal: float
) -> tuple[TrajectoryProblem, np.ndarray]:
    """Return a drive to other values of x, y and yaw, and the straight path z_1..z_N."""
    end = move_start(scene.start, **goal)
    problem = make_program(scene, [GoTo(*end[:3])], options=options)
    path = drive_through(scene, scene.start, end, steps=problem.segments).positions
    return problem, path[1:].copy()
