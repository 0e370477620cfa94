"""Trajectories for the solver to start from, and what problems of some of the same phases hand on to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.task.phases import PhaseKey
from vkc_pin.world.trajectory.splicing import fill_missing_values

__all__ = ["PhaseWaypoints", "Seed", "perturbed", "seed_of"]

# [m] and [rad] trust region at first: what is nearly free already is improved in smaller steps
_WARM_RADIUS = 0.2


@dataclass(frozen=True, eq=False)
class Seed:
    """A trajectory to start from.

    Attributes:
        name: The method, and the number of the try if it is not the first.
        z: z_1..z_N, shape (N, n).
        overlap: The most that a waypoint lacks of its clearance beyond `Options.dist_safe` [m]; NaN
            if nobody looked.
        radius: How far the solver believes planes at first, shape (N,); None: as usual.
    """

    name: str
    z: Floats
    overlap: float = float("nan")
    radius: Floats | None = None


@dataclass(frozen=True, eq=False)
class PhaseWaypoints:
    """Waypoints of phases that follow one another.

    Attributes:
        phases: What happens in the phases.
        names: Of the n coordinates.
        waypoints: Their waypoints, for each phase, from its first, which is the last of the phase
            before, to its last.
        seed: The name of the seed that led to them.
    """

    phases: tuple[PhaseKey, ...]
    names: tuple[str, ...]
    waypoints: tuple[Floats, ...]
    seed: str


def seed_of(problem: TrajectoryProblem, parts: Sequence[PhaseWaypoints]) -> Seed:
    """Return the waypoints of `parts`, one after the other, as those of the whole problem, however many these are."""
    chain = problem.chain
    z = np.full((problem.segments, chain.size), np.nan)
    begin = number = 0
    for part in parts:
        count = len(part.phases)
        phases = problem.task.phases[number : number + count]
        if part.phases != tuple(phase.key for phase in phases):
            # only to let go of something the robot stands still for a while; here that has no phase
            # of its own
            continue
        number += count
        known = [
            k for k, name in enumerate(part.names) if name in chain.names
        ]  # the rest belongs to what is held no more
        columns = [chain.index(part.names[k]) for k in known]
        for phase, waypoints in zip(phases, part.waypoints, strict=True):
            z[begin : begin + phase.segments, columns] = _resampled(
                waypoints[:, known], phase.segments
            )
            begin += phase.segments
    z = fill_missing_values(z)
    z = np.where(np.isnan(z), problem.start, z)  # no part moves it
    name = ", ".join(part.seed for part in parts) + ", then all at once"
    return Seed(name, z, radius=np.full(problem.segments, _WARM_RADIUS))


def _resampled(waypoints: Floats, segments: int) -> Floats:
    """Return `segments` waypoints after the first along those given, shape (K, n)."""
    if len(waypoints) == segments + 1:
        return waypoints[1:]
    at = np.linspace(0.0, len(waypoints) - 1, segments + 1)[1:]
    return np.stack(
        [np.interp(at, np.arange(len(waypoints)), column) for column in waypoints.T], axis=1
    )


def perturbed(
    problem: TrajectoryProblem, z: Floats, deviation: float, rng: np.random.Generator
) -> Floats:
    """Return a seed with smooth noise on the robot's coordinates: half waves in time, of amplitudes as their lengths squared."""
    robot, waves = problem.chain.robot.coordinates.size, np.arange(1, len(z) + 1)
    shape = np.sin(np.pi * np.outer(waves / (len(z) + 1), waves)) / waves**2
    noise = (
        shape @ rng.normal(0.0, deviation, (len(waves), robot)) / np.sqrt(np.sum(0.5 / waves**4))
    )
    z = z.copy()
    z[:, :robot] += noise
    return problem.clip(z)
