"""Finds base poses for the arm's part, and postures of the arm for driving."""

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
from vkc_pin.planning.nlp.kinematic_problem import KinematicProblem
from vkc_pin.planning.solver.trust_region import CLEARANCE_TOLERANCE
from vkc_pin.utils.arrays import Floats

ENOUGH = 50
"""Sufficient number of collision-free configurations."""
TRIES = 20_000
"""Largest number of sampled configurations."""
# [rad] difference up to which two arms are the same
_SAME = 1e-6


def find_base_poses(
    problem: KinematicProblem, waypoint: int, near: Floats, rng: np.random.Generator
) -> Floats:
    """Return feasible, collision-free configurations at a waypoint, shape (K, n), nearest first.

    As in the code of Jiao et al. (IROS 2021): inverse kinematics of base and arm together from
    random configurations, up to `ENOUGH` solutions in `TRIES` tries.

    Args:
        problem: The problem.
        waypoint: The waypoint.
        near: Configuration from which distances are measured by
            `VirtualKinematicChain.metric`, shape (n,).
        rng: Random generator.
    """
    sampler = KeyframeSampler(problem, rng)
    found: list[Floats] = []
    batch_count = -(-TRIES // SAMPLE_COUNT)
    for _ in range(batch_count):
        z, is_solved = sampler.sample(np.tile(near, (SAMPLE_COUNT, 1)), waypoint, "scatter")
        z = z[is_solved]
        if len(z):
            is_free = sampler.compute_shortfall(z, waypoint) <= 0.0
            found.extend(z[is_free])
        if len(found) >= ENOUGH:
            break
    z = np.array(found[:ENOUGH]).reshape(-1, problem.chain.size)
    return z[np.argsort(np.abs(z - near) @ sampler.weights, kind="stable")]


def generate_postures(problem: KinematicProblem) -> Iterator[Floats]:
    """Yield paths of the arm, shape (K, n), to collision-free postures for driving.

    They are: no motion (K = 0); away from a released object, or up with a grasped one; from there
    to home; and from there folded, for narrow passages.
    """
    robot = problem.chain.robot
    arm = slice(3, robot.coordinates.size)
    sampler = KeyframeSampler(problem, np.random.default_rng(0))

    def is_free(path: Floats) -> bool:
        end = path[-1:] if len(path) else problem.start[None]
        return bool(sampler.compute_shortfall(end, problem.segments)[0] <= CLEARANCE_TOLERANCE)

    away = ApproachPaths(sampler).find_release_retreat(problem.start, problem.task.phases[0])
    home = (away[-1] if len(away) else problem.start).copy()
    home[arm] = robot.home
    paths = [np.empty((0, problem.chain.size))]
    if len(away):
        paths.append(away)
    if not is_at_home(problem):
        paths.append(np.vstack([away, home]))
    for path in paths:
        if is_free(path):
            yield path
    folded = home.copy()
    folded[arm] = BaseRoutes(problem).get_folded_arm(0)
    path = np.vstack([paths[-1], folded])
    if is_free(path):
        yield path


def is_at_home(problem: KinematicProblem) -> bool:
    """Return whether the arm is at home at the start."""
    robot = problem.chain.robot
    return bool(np.abs(problem.start[3 : robot.coordinates.size] - robot.home).max() < _SAME)


def interpolate_path(problem: KinematicProblem, path: Floats) -> Floats:
    """Return waypoints from the start through configurations, shape (K, n): shape (N, n)."""
    points = np.vstack([problem.start, path])
    steps = np.abs(np.diff(points, axis=0)).max(axis=1)
    lengths = np.concatenate([[0.0], np.cumsum(steps)])
    at = lengths[-1] * sample_smoothstep(problem.segments)
    columns = [np.interp(at, lengths, column) for column in points.T]
    return problem.clip(np.column_stack(columns))
