"""Trust region: how far the witness planes are believed, and how that is learned from round to round."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["Step", "TrustRegion"]

BLOCK = 10  # waypoints that share a radius
FIRST_RADIUS, RESTART_RADIUS, SETTLE_RADIUS, MIN_RADIUS, SHRINK = 0.5, 0.2, 0.05, 5e-3, 0.4  # [m] and [rad]
NO_MATTER = 2e-3  # [m] of shortfall, summed over a block, that does not matter
CLOSE_ENOUGH = 5e-4  # [m] shortfall of clearance at a waypoint that is none


class Step(Protocol):
    """What a round led to, at every waypoint, shape (N,) [m]."""

    @property
    def slack(self) -> NDArray[np.float64]:
        """What the planes let be missing."""

    @property
    def shortfall(self) -> NDArray[np.float64]:
        """What is missing."""

    @property
    def step(self) -> NDArray[np.float64]:
        """The largest change of a coordinate."""


class TrustRegion:
    """How far waypoints may move in a round: the same for all of a block, so that trouble in one place does not hold up others.

    Attributes:
        radius: Of each waypoint, shape (N,) [m] and [rad].
    """

    def __init__(self, segments: int, radius: NDArray[np.float64] | None = None) -> None:
        self.block = np.arange(segments) * max(1, round(segments / BLOCK)) // segments
        self.radius = np.full(segments, FIRST_RADIUS) if radius is None else radius.copy()

    def adapt(self, before: NDArray[np.float64], trial: Step, accepted: bool, ratio: float) -> None:
        """Widen blocks where what was promised came true, narrow those where it did not.

        Args:
            before: Shortfall of clearance at every waypoint before the round, shape (N,) [m].
            trial: Where the round led.
            accepted: Whether it goes on from there.
            ratio: How much of the promised decrease of the merit came true.
        """
        blocks = int(self.block[-1]) + 1
        promised, actual, worse = np.zeros(blocks), np.zeros(blocks), np.zeros(blocks, bool)
        np.add.at(promised, self.block, before - trial.slack)
        np.add.at(actual, self.block, before - trial.shortfall)
        step = np.zeros(blocks)
        np.maximum.at(step, self.block, trial.step)
        worse = (promised - actual > NO_MATTER) & (actual < 0.25 * promised)
        if not accepted and not worse.any():
            worse[:] = True
        good = (actual > 0.7 * promised - NO_MATTER) & accepted & (ratio > 0.25)
        factor = np.where(worse, 0.0, np.where(good, 1.5, 1.0))
        radius = np.array([self.radius[self.block == b][0] for b in range(blocks)])
        radius = np.where(worse, SHRINK * np.minimum(radius, step), radius * factor)
        self.radius = np.maximum(radius, 1e-6)[self.block]

    def settle(self) -> None:
        """Let waypoints move so little that planes are as good as distances."""
        self.radius = np.minimum(self.radius, SETTLE_RADIUS)

    def stuck(self, trial: Step, shortfall: NDArray[np.float64]) -> bool:
        """Return whether nothing moves any more where something is in the way."""
        bad = shortfall > CLOSE_ENOUGH
        if not bad.any():
            bad[:] = True
        return bool((np.minimum(self.radius, trial.step)[bad] < MIN_RADIUS).all())

    def restart(self) -> None:
        """Begin again, less boldly."""
        self.radius = np.full(len(self.radius), RESTART_RADIUS)
