"""How long the steps of a motion take, and how far that lets coordinates go in them (eq. 5)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from vkc_pin.utils.arrays import Floats

__all__ = ["Timing", "runs_between", "time_for"]

# how much more time a motion may take before limits on its rates become rows of the program
_PATIENCE = 1.5
_SLACK = 1.15  # how much longer a motion may take than the profile 3s² − 2s³ along its seed

Runs = Sequence[tuple[int, int]]


@dataclass(frozen=True, eq=False)
class Timing:
    """The time of every step, one value within each run between two stops.

    Attributes:
        dt: Time of every step [s], shape (N,).
        least: Time of every step of the motion that this was made for [s], shape (N,).
        runs: The runs, as first and last waypoint.
        limits: Of the velocities and accelerations of coordinates, shapes (n,), SI units.
    """

    dt: Floats
    least: Floats
    runs: Runs
    limits: tuple[Floats, Floats]

    @cached_property
    def velocity(self) -> Floats:
        """Bounds of the steps δz, shape (N, n): limits times dt."""
        return np.asarray(self.limits[0] * self.dt[:, None])

    @cached_property
    def acceleration(self) -> Floats:
        """Bounds of the differences δδz, shape (N + 1 + stops, n): limits times dt²."""
        of_rows = np.concatenate(
            [np.full(last - first + 1, self.dt[first]) for first, last in self.runs]
        )
        return np.asarray(self.limits[1] * of_rows[:, None] ** 2)

    def violation(self, first: Floats, second: Floats, needed: Floats | float = 0.0) -> float:
        """Return the largest excess of steps and their differences over their bounds, relative to these; see `pace`.

        Args:
            first: Steps δz, shape (N, n).
            second: Their differences, shape (N + 1 + stops, n).
            needed: How long each step takes at least for other reasons, shape (N,) [s].
        """
        fast, strong = (
            np.max(np.abs(first) / self.velocity),
            np.max(np.abs(second) / self.acceleration),
        )
        return float(max(fast, strong, np.max(needed / self.dt)) - 1.0)

    def stretched(self, first: Floats, second: Floats, needed: Floats | float = 0.0) -> Timing:
        """Return a timing that gives runs up to `_PATIENCE` times the least time where a bound is exceeded; see `violation`."""
        fast = np.maximum(np.max(np.abs(first) / self.velocity, axis=1), needed / self.dt)
        strong = np.max(np.abs(second) / self.acceleration, axis=1)
        dt = self.dt.copy()
        for number, (begin, end) in enumerate(self.runs):
            excess = max(
                float(fast[begin:end].max()),
                float(np.sqrt(strong[begin + number : end + number + 1].max())),
            )
            dt[begin:end] = np.clip(
                dt[begin:end] * excess * 1.001, dt[begin:end], _PATIENCE * self.least[begin:end]
            )
        return replace(self, dt=dt)


def runs_between(stops: Sequence[int], segments: int) -> Runs:
    """Return the stretches between two stops, as first and last waypoint, of a motion of so many segments."""
    return tuple(itertools.pairwise([0, *stops, segments]))


def time_for(
    path: Floats, dt: float, runs: Runs, limits: tuple[Floats, Floats], least: Floats | None = None
) -> Floats:
    """Return the time of every step, shape (N,) [s]: `dt`, or more in runs where z_0..z_N, shape (N + 1, n), is too long for it.

    The measure is the profile 3s² − 2s³ over the distance that each coordinate moves between two
    stops: its speed is at most 1.5 times the mean, its acceleration 6 times the distance over the
    square of the duration.

    Args:
        path: The waypoints, the start first.
        dt: The shortest time of a step [s].
        runs: See `runs_between`.
        limits: Of velocity and acceleration (eq. 5), shape (n,) each, SI units.
        least: How long each step takes at least for other reasons, shape (N,) [s].
    """
    velocity, acceleration = limits
    steps = np.abs(np.diff(path, axis=0))
    times, least = np.full(len(steps), dt), np.zeros(len(steps)) if least is None else least
    for first, last in runs:
        distance = steps[first:last].sum(axis=0)
        fastest, strongest = (
            np.max(1.5 * distance / velocity),
            np.sqrt(np.max(6.0 * distance / acceleration)),
        )
        needed = max(fastest, strongest, 1.5 * least[first:last].sum())
        times[first:last] = np.maximum(times[first:last], _SLACK * needed / (last - first))
    return times
