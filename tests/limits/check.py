"""Samples a motion at 1 kHz and compares it and its derivatives with limits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .files import Limits, Motion

__all__ = ["RATE", "Excess", "Verdict", "check_motion"]

RATE = 1000.0  # [Hz]
SLACK = 1e-6  # relative excess over a rate limit: rounding
OUTSIDE = 1e-6  # [m] or [rad] beyond a position limit: rounding
REST = 1e-6  # [m/s] or [rad/s] at both ends


@dataclass(frozen=True)
class Excess:
    """A violated limit: quantity, coordinate, time [s], value and limit."""

    quantity: str
    name: str
    time: float
    value: float
    limit: float

    def __str__(self) -> str:
        where = f"{self.quantity} of {self.name} at {self.time:.3f} s"
        return f"{where}: {self.value:.9g}, limit {self.limit:.9g}"


@dataclass(frozen=True)
class Verdict:
    """Number of samples, violated limits, and largest rates relative to their limits."""

    samples: int
    excesses: list[Excess]
    velocity: float
    acceleration: float


def check_motion(motion: Motion, limits: Mapping[str, Limits]) -> Verdict:
    """Compare a motion with the limits of all its coordinates.

    Velocities and accelerations are checked twice: as derivatives of the cubics, and as differences
    of positions at intervals of 1 ms, independent of the cubics. Jerks are differences of
    accelerations.
    """
    curve = motion.curve
    count = int(np.floor((curve.times[-1] - curve.times[0]) * RATE + 1e-9))
    times = curve.times[0] + np.arange(count + 1) / RATE
    positions, velocities, accelerations = (curve.evaluate(times, order) for order in range(3))
    first, second = np.diff(positions, axis=0) * RATE, np.diff(positions, 2, axis=0) * RATE**2
    excesses, ratios = list[Excess](), {"velocity": 0.0, "acceleration": 0.0}
    for k, name in enumerate(motion.names):
        own_limits = limits[name]
        outside = np.maximum(own_limits.low - positions[:, k], positions[:, k] - own_limits.high)
        excesses += _find_worst(
            "position", name, outside - OUTSIDE, times, positions[:, k], own_limits.high
        )
        for quantity, limit, columns in (
            ("velocity", own_limits.velocity, (velocities[:, k], first[:, k])),
            ("acceleration", own_limits.acceleration, (accelerations[:, k], second[:, k])),
        ):
            for column in columns:
                excesses += _find_worst(
                    quantity, name, np.abs(column) - (1.0 + SLACK) * limit, times, column, limit
                )
                ratios[quantity] = max(ratios[quantity], float(np.abs(column).max() / limit))
        jerks = np.diff(accelerations[:, k]) * RATE  # very large where accelerations jump
        excesses += _find_worst(
            "jerk",
            name,
            np.abs(jerks) - (1.0 + SLACK) * own_limits.jerk,
            times,
            jerks,
            own_limits.jerk,
        )
        ends = curve.velocities[[0, -1], k]
        excesses += _find_worst("rest", name, np.abs(ends) - REST, curve.times[[0, -1]], ends, 0.0)
    return Verdict(len(times), excesses, **ratios)


def _find_worst(
    quantity: str,
    name: str,
    excess: np.ndarray,
    times: np.ndarray,
    values: np.ndarray,
    limit: float,
) -> list[Excess]:
    k = int(np.argmax(excess))
    found = Excess(quantity, name, float(times[k]), float(values[k]), limit)
    return [found] if excess[k] > 0.0 else []
