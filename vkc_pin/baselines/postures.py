"""Where the base may stand for the arm to do its part, and how the arm is held while the base drives alone."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vkc_pin.planning.initialization.approach_paths import ApproachPaths
from vkc_pin.planning.initialization.base_routes import BaseRoutes
from vkc_pin.planning.initialization.keyframes import (
    SAMPLE_COUNT,
    KeyframeSampler,
    sample_smoothstep,
)
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.solver.trust_region import CLEARANCE_TOLERANCE
from vkc_pin.utils.arrays import Floats

__all__ = ["ENOUGH", "TRIES", "at_home", "base_poses", "postures", "through"]

ENOUGH = 50
"""So many configurations free of collision are looked for."""
TRIES = 20_000
"""From at most so many random seeds."""
_SAME = 1e-6  # [rad]


def base_poses(
    problem: TrajectoryProblem, waypoint: int, near: Floats, rng: np.random.Generator
) -> Floats:
    """Return configurations, the nearest first, that are what must hold at a waypoint and are free of collision.

    As in the code of Jiao et al. (IROS 2021): inverse kinematics of base and arm together from
    random seeds, up to `ENOUGH` solutions in `TRIES` tries.

    Args:
        problem: The problem.
        waypoint: The waypoint.
        near: The configuration that they should be near, shape (n,), as
            `VirtualKinematicChain.metric` measures.
        rng: Draws the seeds.

    Returns:
        Configurations, shape (K, n); none if none is found.
    """
    knots = KeyframeSampler(problem, rng)
    found: list[Floats] = []
    for _ in range(-(-TRIES // SAMPLE_COUNT)):
        z, solved = knots.sample(np.tile(near, (SAMPLE_COUNT, 1)), waypoint, "scatter")
        z = z[solved]
        found.extend(z[knots.compute_shortfall(z, waypoint) <= 0.0] if len(z) else [])
        if len(found) >= ENOUGH:
            break
    z = np.array(found[:ENOUGH]).reshape(-1, problem.chain.size)
    return z[np.argsort(np.abs(z - near) @ knots.weights, kind="stable")]


def postures(problem: TrajectoryProblem) -> Iterator[Floats]:
    """Yield configurations, shape (n,), in which the base may drive away from where it is, and the ones that lead to them.

    Each is a path of the arm while the base stands, shape (K, n), and ends in what the base then
    drives in: nothing to do (K = 0), back from what it lets go of, or up with what it carries, from
    there to home, and from there folded, for narrow passages. Those that are not free are left out.

    Args:
        problem: Lets go of what stands fixed in the world and carries the rest along.
    """
    knots, robot = (
        KeyframeSampler(problem, np.random.default_rng(0)),
        problem.chain.robot,
    )  # nothing is drawn

    def is_free(path: Floats) -> bool:
        end = path[-1:] if len(path) else problem.start[None]
        return bool(knots.compute_shortfall(end, problem.segments)[0] <= CLEARANCE_TOLERANCE)

    away = ApproachPaths(knots).find_release_retreat(problem.start, problem.task.phases[0])
    home = (away[-1] if len(away) else problem.start).copy()
    home[3 : robot.coordinates.size] = robot.home
    paths = [np.empty((0, problem.chain.size))]
    paths += [away] if len(away) else []
    paths += [] if at_home(problem) else [np.vstack([away, home])]
    yield from filter(is_free, paths)
    folded = home.copy()
    folded[3 : robot.coordinates.size] = BaseRoutes(problem).get_folded_arm(
        0
    )  # looked for only if nothing else will do
    yield from filter(is_free, [np.vstack([paths[-1], folded])])


def at_home(problem: TrajectoryProblem) -> bool:
    """Return whether the arm is at home at the start."""
    robot = problem.chain.robot
    return bool(np.abs(problem.start[3 : robot.coordinates.size] - robot.home).max() < _SAME)


def through(problem: TrajectoryProblem, path: Floats) -> Floats:
    """Return waypoints from a problem's start through configurations, shape (K, n), to the last of them, shape (N, n)."""
    knots = np.vstack([problem.start, path])
    lengths = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(knots, axis=0)).max(axis=1))])
    at = lengths[-1] * sample_smoothstep(problem.segments)
    return problem.clip(np.column_stack([np.interp(at, lengths, column) for column in knots.T]))
