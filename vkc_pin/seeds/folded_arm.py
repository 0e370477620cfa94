"""The arm folded over the base with what it carries, for passages that are too narrow for the robot as it is."""

from __future__ import annotations

import math

import numpy as np

from vkc_pin.arrays import Floats
from vkc_pin.driving.body import hull_points
from vkc_pin.program.problem import TrajectoryProblem
from vkc_pin.seeds.knots import depth

__all__ = ["folded_arm"]

_POSTURES = 1000  # random postures: with 192 the arm may stay wider than the base, with 4000 it gets no narrower


def folded_arm(problem: TrajectoryProblem, phase: int, resting: Floats) -> Floats:
    """Return the arm, shape (m - 3,) [m] and [rad], with which the robot is compact: the best of random postures.

    What counts is how far the arm, and what is carried, reach from the base's origin along its three axes, in sum. The robot is
    free of collisions with itself and with what it carries. The postures are the same every time.

    Args:
        problem: Whose robot it is.
        phase: In which it carries what it carries.
        resting: Where robot and load rest, shape (n,): what is not the arm stays so; where the base is does not matter.
    """
    chain, rng = problem.chain, np.random.default_rng(0)
    arm, home = slice(3, chain.robot.coordinates.size), chain.robot.home
    turns = np.array([problem.unit(name) == "rad" for name in chain.names[arm]])
    lower = np.where(turns, np.maximum(chain.lower[arm], home - np.pi), chain.lower[arm])
    upper = np.where(turns, np.minimum(chain.upper[arm], home + np.pi), chain.upper[arm])
    z = np.tile(resting, (_POSTURES, 1))
    z[:, arm] = [home, *rng.uniform(lower, upper, (_POSTURES - 1, len(home)))]
    z = z[np.argsort(_size(problem, phase, z), kind="stable")]
    for tried in np.array_split(z, math.isqrt(_POSTURES)):  # one of the first is mostly free
        free = depth(problem, tried, problem.contacts.inside(phase), standing=False) <= 0.0
        if free.any():
            return tried[np.argmax(free), arm].copy()
    return home.copy()


def _size(problem: TrajectoryProblem, phase: int, z: Floats) -> Floats:
    """Return how far what the base carries in a phase reaches along the base's axes, in sum, shape (B,) [m]."""
    chain, shapes = problem.chain, problem.contacts.phases[phase].shapes
    rotations, translations = chain.joint_placements(z)
    reach = np.zeros((len(z), 3))
    carried = problem.contacts.carried(phase)
    for shape in (shapes[i] for i in [*range(len(chain.robot.collision.geometryObjects)), *carried]):
        joint = shape.parentJoint
        if joint > 1:
            corners, radius = hull_points(shape.geometry, shape.placement, outer=True)
            at = rotations[:, joint] @ corners.T + translations[:, joint, :, None] - translations[:, 1, :, None]
            np.maximum(reach, np.abs(rotations[:, 1].transpose(0, 2, 1) @ at).max(axis=2) + radius, out=reach)
    return np.asarray(reach.sum(axis=1))
