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
    """

    dt: Floats
    least: Floats
    runs: Runs
    limits: tuple[Floats, Floats]

    @cached_property
    def velocity(self) -> Floats:
        """Bounds of the steps δz, shape (N, n): velocity limits times dt."""
        return np.asarray(self.limits[0] * self.dt[:, None])

    @cached_property
    def acceleration(self) -> Floats:
        """Bounds of the changes δδz, shape (N + 1 + stops, n): acceleration limits times dt²."""
        runs = [np.full(last - first + 1, self.dt[first]) for first, last in self.runs]
        row_durations = np.concatenate(runs)
        return np.asarray(self.limits[1] * row_durations[:, None] ** 2)

    def compute_violation(
        self, first: Floats, second: Floats, needed: Floats | float = 0.0
    ) -> float:
        """Return the largest bound violation of a `pace`, relative to the bounds.

        Args:
            first: Steps δz, shape (N, n); see `TrajectoryProblem.pace`.
            second: Changes δδz, shape (N + 1 + stops, n).
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
        acceleration_ratios = np.max(np.abs(second) / self.acceleration, axis=1)
        dt = self.dt.copy()
        for number, (begin, end) in enumerate(self.runs):
            # A run of m steps has m + 1 changes. Steps that take k times as long have bounds k and
            # k² times as large.
            changes_of_run = slice(begin + number, end + number + 1)
            by_velocity = float(velocity_ratios[begin:end].max())
            by_acceleration = float(np.sqrt(acceleration_ratios[changes_of_run].max()))
            factor = max(by_velocity, by_acceleration)
            stretched = dt[begin:end] * factor * _STRETCH_MARGIN
            dt[begin:end] = np.clip(stretched, dt[begin:end], _MAX_STRETCH * self.least[begin:end])
        return replace(self, dt=dt)


def split_at_stops(stops: Sequence[int], segments: int) -> Runs:
    """Return the runs between stops of a motion with `segments` steps, as (first, last)."""
    return tuple(itertools.pairwise([0, *stops, segments]))


def compute_step_times(
    path: Floats, dt: float, runs: Runs, limits: tuple[Floats, Floats], least: Floats | None = None
) -> Floats:
    """Return step durations, shape (N,) [s]: `dt`, or more in runs that are too long for it.

    A run's duration follows from the profile 3s² − 2s³ over the distance that each coordinate
    covers in it: the peak velocity is 1.5 times the mean, the peak acceleration 6 times the
    distance divided by the squared duration.

    Args:
        path: z_0..z_N, shape (N + 1, n).
        dt: Minimum step duration [s].
        runs: See `split_at_stops`.
        limits: Velocity and acceleration limits (eq. 5), shape (n,) each, SI units.
        least: Minimum duration of each step for other reasons, shape (N,) [s].
    """
    velocity, acceleration = limits
    steps = np.abs(np.diff(path, axis=0))
    times = np.full(len(steps), dt)
    if least is None:
        least = np.zeros(len(steps))
    for first, last in runs:
        distance = steps[first:last].sum(axis=0)
        velocity_time = np.max(1.5 * distance / velocity)
        acceleration_time = np.sqrt(np.max(6.0 * distance / acceleration))
        duration = max(velocity_time, acceleration_time, 1.5 * least[first:last].sum())
        step_time = _DURATION_MARGIN * duration / (last - first)
        times[first:last] = np.maximum(times[first:last], step_time)
    return times
