"""Finds collision-free configurations of the robot at a pose."""

from __future__ import annotations

from typing import Any

import numpy as np

from vkc_pin.options import Options
from vkc_pin.planning.initialization.keyframes import (
    SIMILARITY_TOLERANCE,
    find_free_configurations,
    sample_goal_configurations,
)
from vkc_pin.planning.nlp.kinematic_problem import KinematicProblem
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.utils.arguments import check_bool, check_instance, check_integer
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.steps import Reach

_MAX_BATCHES = 8
"""Batches of random configurations that are tried."""


def inverse_kinematics(
    scene: Scene,
    pose: Any,
    *,
    frame: str | None = None,
    count: int = 1,
    fix_base: bool = False,
    options: Options | None = None,
    seed: int = 0,
) -> Floats:
    """Find collision-free configurations of the robot that bring a frame to a pose.

    Configurations from random ones by damped least squares, within the robot's limits and with the
    clearances of planning, the nearest to the scene's start first. Held free objects come along.

    Args:
        scene: The scene. Its start is where the robot comes from.
        pose: Pose in the world frame, as of `Reach`.
        frame: Frame of the robot; None: the tool frame.
        count: Largest number of configurations.
        fix_base: Whether the base stays at the start.
        options: Clearances. Default: `Options()`.
        seed: Random seed.

    Returns:
        Different configurations, shape (K, n) with K ≤ `count`, [m] and [rad], in the order of
        `scene.robot.coordinates.names`; none if none was found, which proves nothing.

    Raises:
        InputError: An argument is invalid.
    """
    check_instance(scene, Scene, "scene")
    options = Options() if options is None else check_instance(options, Options, "options")
    count = check_integer(count, "count", low=1)
    rng = np.random.default_rng(check_integer(seed, "seed", low=0))
    task = compile_task(scene, [Reach(pose, frame)], options)
    problem = KinematicProblem(scene, task, options)
    end = problem.segments
    if check_bool(fix_base, "fix_base"):
        lower, upper = problem.lower.copy(), problem.upper.copy()
        lower[:, :3] = upper[:, :3] = problem.start[:3]
        problem = problem.with_bounds(lower, upper)
    found = np.zeros((0, problem.chain.size))
    for _ in range(_MAX_BATCHES):
        samples = sample_goal_configurations(problem, end, rng)
        assert samples is not None, "a pose is a goal"
        z, residual = samples
        reached = z[residual < TOLERANCE]
        free = reached[find_free_configurations(problem, reached, end)]
        found = _select_distinct(np.vstack([found, free]))
        if len(found) >= count:
            break
    distances = np.linalg.norm((found - problem.start) * problem.chain.metric, axis=1)
    nearest = np.argsort(distances, kind="stable")[:count]
    return np.asarray(found[nearest, : scene.robot.coordinates.size])


def _select_distinct(z: Floats) -> Floats:
    """Return the configurations, shape (B, n), that are not similar to one before them."""
    kept = list[Floats]()
    for row in z:
        if all(np.abs(row - other).max() > SIMILARITY_TOLERANCE for other in kept):
            kept.append(row)
    return np.array(kept).reshape(-1, z.shape[1])
