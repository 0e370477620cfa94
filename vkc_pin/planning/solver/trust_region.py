"""Adapts the trust-region radius of each waypoint to the ratio of actual to predicted reduction."""

from __future__ import annotations

import numpy as np

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.clearance_exemptions import ACCEPTED_SHORTFALL

BLOCK_TIME = 2.5  # [s] of motion that share a radius, at one waypoint per `Options.dt`
FIRST_RADIUS = 0.5  # [m], [rad] initial radius, also after the penalty weights were raised
# fraction of the radius above which a step counts as limited by the trust region (Ipopt ends a
# little inside its bounds)
ACTIVE_FRACTION = 0.9
SETTLE_RADIUS = 0.05  # [m], [rad] within which the planes approximate the distances well
SHRINK = 0.4  # factor on the smaller of radius and step where the prediction was poor
# merit change in a block that is ignored: 8 mm of shortfall at the initial penalty weight
NEGLIGIBLE_CHANGE = 0.4
# [m] shortfall at a waypoint, clearance within segments, and steps (also [rad]) that are
# negligible: half of what validation accepts, so that it accepts all that converges
CLEARANCE_TOLERANCE = ACCEPTED_SHORTFALL / 2


class TrustRegion:
    """Trust-region radii of the waypoints.

    Waypoints of a block share a radius, so that a difficult passage does not slow down the others.

    Args:
        segments: N, the number of waypoints.
        length: Approximate number of waypoints per block.
        radius: Initial radii, shape (N,) [m] or [rad]. Default: `FIRST_RADIUS`.

    Attributes:
        block: Block number of each waypoint, shape (N,).
        radius: Radius at each waypoint, shape (N,) [m] or [rad].
    """

    def __init__(self, segments: int, length: int, radius: Floats | None = None) -> None:
        self.block = np.arange(segments) * max(1, round(segments / length)) // segments
        self.radius = np.full(segments, FIRST_RADIUS) if radius is None else radius.copy()

    def adapt(self, predicted: Floats, actual: Floats, step: Floats, accepted: bool) -> None:
        """Widen blocks in which the prediction was good, shrink those in which it was poor.

        Args:
            predicted: Predicted penalty reduction at each waypoint, shape (N,).
            actual: Actual penalty reduction, shape (N,).
            step: Largest coordinate change at each waypoint, shape (N,) [m] or [rad].
            accepted: Whether the step was accepted.
        """
        blocks = int(self.block[-1]) + 1
        gain, expected, size = np.zeros(blocks), np.zeros(blocks), np.zeros(blocks)
        np.add.at(expected, self.block, predicted)
        np.add.at(gain, self.block, actual)
        np.maximum.at(size, self.block, step)
        poor = (expected - gain > NEGLIGIBLE_CHANGE) & (gain < 0.25 * expected)
        if not accepted and not poor.any():
            poor[:] = True
        radius = np.array([self.radius[self.block == b][0] for b in range(blocks)])
        good = (gain > 0.7 * expected - NEGLIGIBLE_CHANGE) & (size > ACTIVE_FRACTION * radius)
        widened = np.where(good & accepted, 1.5, 1.0) * radius
        radius = np.where(poor, SHRINK * np.minimum(radius, size), widened)
        self.radius = np.maximum(radius, 1e-6)[self.block]

    def limit(self) -> None:
        """Limit the radii to `SETTLE_RADIUS`."""
        self.radius = np.minimum(self.radius, SETTLE_RADIUS)

    def has_stalled(self, step: Floats, shortfall: Floats) -> bool:
        """Return whether the waypoints that lack clearance, or else all, no longer move.

        Args:
            step: Largest coordinate change at each waypoint, shape (N,) [m] or [rad].
            shortfall: Clearance violation at each waypoint, shape (N,) [m].
        """
        violated = shortfall > CLEARANCE_TOLERANCE
        if not violated.any():
            violated[:] = True
        return bool((np.minimum(self.radius, step)[violated] < CLEARANCE_TOLERANCE).all())

    def reset(self) -> None:
        """Reset all radii to `FIRST_RADIUS`."""
        self.radius = np.full(len(self.radius), FIRST_RADIUS)


def is_step_acceptable(predicted: float, actual: float, merit: float) -> bool:
    """Return whether to accept a step.

    Args:
        predicted: Predicted reduction of the merit function.
        actual: Actual reduction.
        merit: Merit of the iterate.
    """
    negligible = 1e-4 * max(1.0, abs(merit))
    if predicted < negligible:
        return actual >= -negligible
    return actual > 0.05 * predicted
