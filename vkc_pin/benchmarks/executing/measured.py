"""Provides starts from grasps in physics, as measured, and with a hand that closed elsewhere."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.planning.initialization.keyframes import KeyframeSampler
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.planner import plan
from vkc_pin.simulation.execution import simulate
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.steps import Actuate, Grasp, Place, Reach

__all__ = ["DEGREES_PER_MM", "displace_hand", "grasp_in_physics"]

DEGREES_PER_MM = 0.4
"""Rotation of a displaced hand per displacement [°/mm]."""
_DRAWS = 20  # directions that are tried
_TOLERANCE = 1e-8  # [m], [rad] of inverse kinematics


def grasp_in_physics(
    scene: Scene, step: Actuate | Place, seed: int, grasp: str, limits: Any
) -> tuple[Plan, Scene | None]:
    """Plan and execute the grasp of the object that a step moves.

    Returns:
        Plan, and the scene as measured after its execution; None if either failed.
    """
    found = plan(scene, [Grasp(step.object, step.attachment)], seed=seed, **limits)
    if not found.success:
        return found, None
    executed = simulate(scene, found.steps, found.trajectory, grasp=grasp)
    return found, executed.end_scene() if executed.ok else None


def displace_hand(scene: Scene, distance: float, rng: np.random.Generator) -> Scene:
    """Return a scene in which the hand holds the object elsewhere, by a random displacement.

    Args:
        scene: Scene with a held object.
        distance: Displacement of the hand [mm]; see `DEGREES_PER_MM`.
        rng: Random generator of directions.

    Raises:
        InputError: The robot cannot reach there.
    """
    (hold,), tool = scene.holds, scene.tool_placement()
    for _ in range(_DRAWS):
        shift, turn = (draw / np.linalg.norm(draw) for draw in rng.normal(size=(2, 3)))
        turn *= np.radians(DEGREES_PER_MM * distance)
        row = _reach(scene.with_held({}), tool * pin.SE3(pin.exp3(turn), 1e-3 * distance * shift))
        if row is not None:
            return scene.with_measured_grasp(hold.object, base=row[:3], arm=row[3:])
    raise InputError("the robot cannot hold the object elsewhere", got=f"{distance:g} mm off")


def _reach(scene: Scene, tool: pin.SE3) -> Floats | None:
    """Return the configuration near the start that brings the tool to a pose; None if none."""
    options = Options()
    problem = TrajectoryProblem(scene, compile_task(scene, [Reach(tool)], options), options)
    search = KeyframeSampler(problem, np.random.default_rng(0))
    pose = search.find_pose(problem.segments)
    assert pose is not None
    solver, target = search.get_pose_solver(pose)
    z, found = solver.solve(
        problem.start[None].copy(),
        target,
        lower=problem.chain.lower[None],
        upper=problem.chain.upper[None],
        weights=search.weights,
        iterations=100,
        tolerance=_TOLERANCE,
    )
    return np.asarray(z[0]) if found[0] else None
