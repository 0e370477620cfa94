"""Samples start configurations in which the robot grasps an object."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vkc_pin.options import Options
from vkc_pin.planning.initialization.keyframes import KeyframeSampler, compute_shortfall
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.planner import Planner
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.steps import Actuate
from vkc_pin.world.task.terms import Term, trace_terms

__all__ = ["find_grasping_start"]

_BATCH = 48  # random configurations that inverse kinematics brings to the grasp at once
_DRAWS = 6  # batches before there is none


def find_grasping_start(
    scene: Scene,
    step: Actuate,
    rng: np.random.Generator,
    options: Options,
    planner: Planner,
    terms: Sequence[Term] = (),
) -> Scene | None:
    """Return the scene with a random free configuration that grasps the object of a step.

    The search uses the program of the step's plan.

    Args:
        scene: Scene.
        step: Step with its attachment.
        rng: Random generator.
        options: Options with clearances.
        planner: Planner whose caches are used.
        terms: Additional terms of the program; the start may violate them.

    Returns:
        The scene, or None if no configuration was found.
    """
    name, attachment = step.object, str(step.attachment)
    holding = scene.with_held(
        {name: attachment}
    )  # wherever the hand is: the chain does not depend on it
    with planner.acquire() as cache:
        problem = TrajectoryProblem(
            holding,
            compile_task(holding, [step], options),
            options,
            trace_terms(scene, terms),
            cache=cache,
        )
        chain, robot = problem.chain, scene.robot.coordinates.size
        search = KeyframeSampler(problem, rng)
        pose = search.find_pose(1)
        freedoms = [
            chain.index(f"{name}.{own}")
            for own in scene.objects[name].object.attachments[attachment].coordinates
        ]
        if pose is None:
            return None
        solver, target = search.get_pose_solver(pose)
        for _ in range(_DRAWS):
            z = np.tile(problem.start, (_BATCH, 1))
            z[:, freedoms] = rng.uniform(
                chain.lower[freedoms], chain.upper[freedoms], (_BATCH, len(freedoms))
            )
            z, _ = search.sample(z, 1, "scatter")
            z[:, search.object_columns] = problem.start[
                search.object_columns
            ]  # as it is at the start, not a step later
            lower, upper = np.tile(chain.lower, (_BATCH, 1)), np.tile(chain.upper, (_BATCH, 1))
            fixed = [*freedoms, *search.object_columns.tolist()]
            lower[:, fixed] = upper[:, fixed] = z[:, fixed]
            z, found = solver.solve(
                z, target, lower=lower, upper=upper, weights=search.weights, tolerance=_EXACT
            )
            z = z[found]
            z = z[compute_shortfall(problem, z, 0) <= 0.0] if len(z) else z
            if len(z):
                row = z[int(rng.integers(len(z)))]
                there = scene.with_start(base=row[:3], arm=row[3:robot])
                return there.with_held([Hold(name, attachment, at=tuple(row[freedoms].tolist()))])
    return None


_EXACT = 1e-2 * TOLERANCE  # [m], [rad]: accepted distance of the hand from its grasp
