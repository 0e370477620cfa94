"""Defines initial guesses for the solver, and makes them from solutions of parts of a task."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vkc_pin.planning.nlp.kinematic_problem import KinematicProblem
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.task.phases import PhaseKey
from vkc_pin.world.trajectory.splicing import fill_missing_values
from vkc_pin.world.trajectory.trajectory import Trajectory

_DEEP = 0.1  # [m] penetration of a guess beyond which the solver seldom succeeds: 2 of 79
# [m], [rad] initial trust region: a nearly feasible guess is improved in smaller steps
_WARM_RADIUS = 0.2


@dataclass(frozen=True, eq=False)
class InitialGuess:
    """Initial guess of a trajectory.

    Attributes:
        name: Initialization method, with the number of the attempt from the second on.
        z: z_1..z_N, shape (N, n).
        penetration: Largest clearance shortfall at a waypoint beyond `Options.dist_safe` [m]; NaN
            if unknown.
        radius: Initial trust-region radii, shape (N,) [m] or [rad]. Default: the solver's.
    """

    name: str
    z: Floats
    penetration: float = float("nan")
    radius: Floats | None = None

    @property
    def is_deep(self) -> bool:
        """Whether it penetrates too deeply for the solver to resolve it in most cases."""
        return self.penetration > _DEEP


@dataclass(frozen=True, eq=False)
class PhaseWaypoints:
    """Waypoints of consecutive phases.

    Attributes:
        phases: Keys of the phases.
        names: Names of the n coordinates.
        waypoints: Waypoints of each phase, from the last one of the phase before to its own last.
        initialization: Name of the initial guess that led to them.
    """

    phases: tuple[PhaseKey, ...]
    names: tuple[str, ...]
    waypoints: tuple[Floats, ...]
    initialization: str


def extract_phase_waypoints(
    problem: KinematicProblem, z: Floats, initialization: str
) -> PhaseWaypoints:
    """Return z_1..z_N of a problem, shape (N, n), as waypoints of its phases."""
    phases = tuple(phase.key for phase in problem.task.phases)
    path = problem.waypoints(z)
    ends = [0, *problem.ends.tolist()]
    waypoints = tuple(path[first : last + 1] for first, last in itertools.pairwise(ends))
    return PhaseWaypoints(phases, problem.chain.names, waypoints, initialization)


def make_initial_guess(problem: KinematicProblem, parts: Sequence[PhaseWaypoints]) -> InitialGuess:
    """Concatenate waypoints of parts of a task to an initial guess for the whole task."""
    chain = problem.chain
    phases = iter(problem.task.phases)
    phase = next(phases, None)
    begin = 0
    z = np.full((problem.segments, chain.size), np.nan)
    for part in parts:
        # The other coordinates belong to objects that are no longer attached.
        known = [k for k, name in enumerate(part.names) if name in chain.names]
        columns = [chain.index(part.names[k]) for k in known]
        for key, waypoints in zip(part.phases, part.waypoints, strict=True):
            # A phase that only waits for the gripper to open is no phase of the whole task.
            if phase is not None and key == phase.key:
                end = begin + phase.segments
                z[begin:end, columns] = _resample(waypoints[:, known], phase.segments)
                begin = end
                phase = next(phases, None)
    z = fill_missing_values(z)
    z = np.where(np.isnan(z), problem.start, z)  # coordinates that no part moves
    name = ", ".join(part.initialization for part in parts) + ", then all at once"
    return InitialGuess(name, z, radius=np.full(problem.segments, _WARM_RADIUS))


def make_guess_from_motion(problem: KinematicProblem, motion: Trajectory) -> InitialGuess:
    """Make an initial guess from an earlier motion of the same steps, or of some of them.

    A phase starts from the motion's next phase of the same name. Phases without one, and
    coordinates that the motion lacks, stay where they were.
    """
    chain = problem.chain
    known = [name for name in motion.names if name in chain.names]
    columns = [chain.index(name) for name in known]
    positions = motion.positions[:, [motion.names.index(name) for name in known]]
    z = np.full((problem.segments, chain.size), np.nan)
    after = 0  # number of the motion's next phase
    begin = 0
    for phase in problem.task.phases:
        end = begin + phase.segments
        for number, span in enumerate(motion.phases[after:], start=after):
            if span.name == phase.name:
                waypoints = _skip_pause(positions[span.first : span.last + 1])
                z[begin:end, columns] = _resample(waypoints, phase.segments)
                after = number + 1
                break
        begin = end
    z = np.vstack([problem.start, z])
    z = problem.clip(fill_missing_values(z)[1:])
    return InitialGuess("given", z, radius=np.full(problem.segments, _WARM_RADIUS))


def _skip_pause(waypoints: Floats) -> Floats:
    """Return waypoints without those at the begin at which the gripper opens or closes."""
    moves = np.flatnonzero(np.any(waypoints != waypoints[0], axis=1))
    first = moves[0] - 1 if len(moves) else 0
    return waypoints[first:]


def _resample(waypoints: Floats, segments: int) -> Floats:
    """Resample waypoints to `segments` ones after the first."""
    if len(waypoints) == segments + 1:
        return waypoints[1:]
    at = np.linspace(0.0, len(waypoints) - 1, segments + 1)[1:]
    numbers = np.arange(len(waypoints))
    columns = [np.interp(at, numbers, column) for column in waypoints.T]
    return np.stack(columns, axis=1)


def perturb(
    problem: KinematicProblem, z: Floats, deviation: float, rng: np.random.Generator
) -> Floats:
    """Add smooth noise of some standard deviation [m] or [rad] to the robot's part of z, (N, n).

    Noise at waypoint t is Σ_k a_k sin(π k t/(N + 1))/k², zero at both ends, with random amplitudes
    a_k. The mean square of a sine is 1/2, so that the variance is Σ_k 1/(2 k⁴) times theirs.
    """
    robot = problem.chain.robot.coordinates.size
    waves = np.arange(1, len(z) + 1)  # k, and also t
    shape = np.sin(np.pi * np.outer(waves / (len(z) + 1), waves)) / waves**2
    amplitudes = rng.normal(0.0, deviation, (len(waves), robot))
    noise = shape @ amplitudes / np.sqrt(np.sum(0.5 / waves**4))
    z = z.copy()
    z[:, :robot] += noise
    return problem.clip(z)
