"""Where the base may stand for the arm to do its part: what a user of a planner for base and arm apart has to find out."""

from __future__ import annotations

import numpy as np

from vkc_pin.arrays import Floats
from vkc_pin.interrupt import NEVER, Interrupt
from vkc_pin.program.problem import TrajectoryProblem
from vkc_pin.seeds.knots import SCATTER, Knots

__all__ = ["ENOUGH", "TRIES", "base_poses"]

ENOUGH = 50
"""So many configurations free of collision are looked for."""
TRIES = 20_000
"""From at most so many random seeds."""


def base_poses(
    problem: TrajectoryProblem, waypoint: int, near: Floats, rng: np.random.Generator, interrupt: Interrupt = NEVER
) -> Floats:
    """Return configurations, the nearest first, that are what must hold at a waypoint and are free of collision.

    As in the code of Jiao et al. (IROS 2021): inverse kinematics of base and arm together from random seeds, up to `ENOUGH`
    solutions in `TRIES` tries.

    Args:
        problem: The problem.
        waypoint: The waypoint.
        near: The configuration that they should be near, shape (n,): a metre of the base counts as three radians of a joint.
        rng: Draws the seeds.
        interrupt: Ends the search, with what was found.

    Returns:
        Configurations, shape (K, n); none if none is found.
    """
    knots = Knots(problem, rng)
    found: list[Floats] = []
    for _ in range(-(-TRIES // SCATTER)):
        z, solved = knots.knot(np.tile(near, (SCATTER, 1)), waypoint, "scatter")
        z = z[solved]
        found.extend(z[knots.depth(z, waypoint) <= 0.0] if len(z) else [])
        if len(found) >= ENOUGH or interrupt.pressed:
            break
    z = np.array(found[:ENOUGH]).reshape(-1, problem.chain.size)
    return z[np.argsort(np.abs(z - near) @ knots.weights, kind="stable")]
