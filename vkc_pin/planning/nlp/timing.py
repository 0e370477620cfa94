"""Computes the durations of steps and the resulting bounds on their size (eq. 5)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from vkc_pin.utils.arrays import Floats

# Factor by which a motion may be slowed down before rate limits become rows of the program.
_MAX_STRETCH = 1.5
_STRETCH_MARGIN = 1.001  # duration relative to the shortest one within the bounds
_DURATION_MARGIN = 1.15  # duration relative to the profile 3s² − 2s³ along the initial guess

Runs = Sequence[tuple[int, int]]


@dataclass(frozen=True, eq=False)
class Timing:
    """The duration of every step, one value per run between two stops.

    Attributes:
        dt: Duration of each step, shape (N,) [s].
        least: Duration of each step of the initial motion, shape (N,) [s].
        runs: First and last waypoint of each run.
        limits: Velocity and acceleration limits of the coordinates, shape (n,) each, SI units.
        end_velocities: Velocities at the start and the end of the motion, shape (2, n), SI units.
    """

    dt: Floats
    least: Floats
    runs: Runs
    limits: tuple[Floats, Floats]
    end_velocities: Floats

    @cached_property
    def velocity(self) -> Floats:
        """Bounds of the steps δz, shape (N, n): velocity limits times dt."""
        return np.asarray(self.limits[0] * self.dt[:, None])

    @cached_property
    def acceleration(self) -> Floats:
        """Bounds of the changes δδz, shape (N + 1 + stops, n): acceleration limits times dt².

        A step has its mean velocity in its middle. Between two steps dt passes, but only half of it
        between a step and an end in motion.
        """
        runs = [np.full(last - first + 1, self.dt[first]) for first, last in self.runs]
        row_durations = np.concatenate(runs)
        bounds = np.asarray(self.limits[1] * row_durations[:, None] ** 2)
        for end, velocity in zip((0, -1), self.end_velocities, strict=True):
            if velocity.any():
                bounds[end] /= 2.0
        return bounds

    def compute_violation(
        self, first: Floats, second: Floats, needed: Floats | float = 0.0
    ) -> float:
        """Return the largest bound violation of a `pace`, relative to the bounds.

        Args:
            first: Steps δz, shape (N, n); see `TrajectoryProblem.pace`.
            second: Changes δδz at these step durations, shape (N + 1 + stops, n).
            needed: Minimum duration of each step for other reasons, shape (N,) [s].
        """
        velocity_ratio = np.max(np.abs(first) / self.velocity)
        acceleration_ratio = np.max(np.abs(second) / self.acceleration)
        return float(max(velocity_ratio, acceleration_ratio, np.max(needed / self.dt)) - 1.0)

    def stretch(self, first: Floats, second: Floats, needed: Floats | float = 0.0) -> Timing:
        """Return a timing with longer steps in runs whose `pace` exceeds a bound.

        No step takes more than `_MAX_STRETCH` times `least`.
        """
        velocity_ratios = np.max(np.abs(first) / self.velocity, axis=1)
        velocity_ratios = np.maximum(velocity_ratios, needed / self.dt)
        change_factors = self._compute_change_factors(second)
        dt = self.dt.copy()
        for number, (begin, end) in enumerate(self.runs):
            # A run of m steps has m + 1 changes. Steps that take k times as long have bounds k and
            # k² times as large.
            changes_of_run = slice(begin + number, end + number + 1)
            by_velocity = float(velocity_ratios[begin:end].max())
            by_acceleration = float(change_factors[changes_of_run].max())
            factor = max(by_velocity, by_acceleration)
            stretched = dt[begin:end] * factor * _STRETCH_MARGIN
            dt[begin:end] = np.clip(stretched, dt[begin:end], _MAX_STRETCH * self.least[begin:end])
        return replace(self, dt=dt)

    def _compute_change_factors(self, second: Floats) -> Floats:
        """Return the factors of the step durations that keep the changes within their bounds.

        All larger factors do, too. With a factor k a change c between two steps has the bound k²·b,
        so that k = √(|c|/b). From the step k·u of the start velocity to the first step δ, with c =
        δ − u at k = 1, the bound is |δ − k·u| ≤ k²·b. For each sign σ its largest root is

            k = √(σδ/b + r²) − σr,   r = u/(2b)

        Args:
            second: Changes δδz at these step durations, shape (N + 1 + stops, n).

        Returns:
            Largest factor of all coordinates, shape (N + 1 + stops,).
        """
        bounds = self.acceleration
        factors = np.sqrt(np.max(np.abs(second) / bounds, axis=1))
        start_step, end_step = compute_end_steps(self.end_velocities, self.dt)
        first_step = second[0] + start_step
        last_step = end_step - second[-1]
        factors[0] = _find_largest_root(first_step, start_step, bounds[0])
        factors[-1] = _find_largest_root(last_step, end_step, bounds[-1])
        return factors


def compute_end_steps(end_velocities: Floats, dt: Floats) -> Floats:
    """Return the steps at both ends' velocities, shape (2, n), in the times of the outer steps.

    Args:
        end_velocities: Velocities at the start and the end, shape (2, n), SI units.
        dt: Step durations, shape (N,) [s].
    """
    return np.asarray(end_velocities * dt[[0, -1], None])


def _find_largest_root(step: Floats, end_step: Floats, bound: Floats) -> float:
    """Return the largest root k of |δ − k·u| = k²·b for all coordinates, shape (n,) each."""
    half = end_step / (2.0 * bound)
    largest = 0.0
    for side in (1.0, -1.0):
        square = side * step / bound + half**2
        roots = np.sqrt(np.maximum(square, 0.0)) - side * half
        largest = max(largest, float(np.where(square >= 0.0, roots, 0.0).max()))
    return largest


def split_at_stops(stops: Sequence[int], segments: int) -> Runs:
    """Return the runs between stops of a motion with `segments` steps, as (first, last)."""
    return tuple(itertools.pairwise([0, *stops, segments]))


def compute_step_times(
    path: Floats,
    dt: float,
    runs: Runs,
    limits: tuple[Floats, Floats],
    least: Floats | None = None,
    end_velocities: Floats | None = None,
) -> Floats:
    """Return step durations, shape (N,) [s]: `dt`, or more in runs that are too long for it.

    A run's duration follows from the profile 3s² − 2s³ over the distance that each coordinate
    covers in it: the peak velocity is 1.5 times the mean, the peak acceleration 6 times the
    distance d divided by the squared duration T. A cubic with velocities v and w at its ends has
    the peak acceleration 6d/T² + (4|v| + 2|w|)/T at most, where |v| ≥ |w|.

    Args:
        path: z_0..z_N, shape (N + 1, n).
        dt: Minimum step duration [s].
        runs: See `split_at_stops`.
        limits: Velocity and acceleration limits (eq. 5), shape (n,) each, SI units.
        least: Minimum duration of each step for other reasons, shape (N,) [s].
        end_velocities: Velocities at the start and the end, shape (2, n), SI units; None: at rest.
    """
    velocity, acceleration = limits
    if end_velocities is None:
        end_velocities = np.zeros((2, path.shape[1]))
    steps = np.abs(np.diff(path, axis=0))
    times = np.full(len(steps), dt)
    if least is None:
        least = np.zeros(len(steps))
    for first, last in runs:
        distance = steps[first:last].sum(axis=0)
        velocity_time = np.max(1.5 * distance / velocity)
        at_ends = np.zeros((2, path.shape[1]))
        if first == 0:
            at_ends[0] = np.abs(end_velocities[0])
        if last == len(steps):
            at_ends[1] = np.abs(end_velocities[1])
        # The root T of T² = 6d/a + 2hT
        half = (4.0 * at_ends.max(axis=0) + 2.0 * at_ends.min(axis=0)) / (2.0 * acceleration)
        acceleration_time = np.max(half + np.sqrt(6.0 * distance / acceleration + half**2))
        duration = max(velocity_time, acceleration_time, 1.5 * least[first:last].sum())
        step_time = _DURATION_MARGIN * duration / (last - first)
        times[first:last] = np.maximum(times[first:last], step_time)
    return times
