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
# ratio of actual to predicted reduction below which a prediction is poor, above which it is good
POOR_RATIO = 0.25
GOOD_RATIO = 0.7
SHRINK = 0.4  # factor on the smaller of radius and step where the prediction was poor
WIDEN = 1.5  # factor on a radius that limited the step where the prediction was good
MIN_RADIUS = 1e-6  # [m], [rad]
# ratio of actual to predicted reduction of the merit above which a step is accepted
ACCEPTANCE_RATIO = 0.05
# change relative to the merit, or to 1, that counts as none
NEGLIGIBLE_MERIT_CHANGE = 1e-4
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

        With the sums a of the actual and p of the predicted reductions of a block, it is good if a
        > 0.7 p, and poor if a < p/4; changes below `NEGLIGIBLE_CHANGE` are neither.

        Args:
            predicted: Predicted penalty reduction at each waypoint, shape (N,).
            actual: Actual penalty reduction, shape (N,).
            step: Largest coordinate change at each waypoint, shape (N,) [m] or [rad].
            accepted: Whether the step was accepted.
        """
        blocks = int(self.block[-1]) + 1
        expected = np.zeros(blocks)
        np.add.at(expected, self.block, predicted)
        gain = np.zeros(blocks)
        np.add.at(gain, self.block, actual)
        size = np.zeros(blocks)
        np.maximum.at(size, self.block, step)
        first_waypoints = np.searchsorted(self.block, np.arange(blocks))
        radius = self.radius[first_waypoints]

        is_poor = (expected - gain > NEGLIGIBLE_CHANGE) & (gain < POOR_RATIO * expected)
        if not accepted and not is_poor.any():
            is_poor[:] = True
        is_good = gain > GOOD_RATIO * expected - NEGLIGIBLE_CHANGE
        is_limited = size > ACTIVE_FRACTION * radius
        widened = np.where(is_good & is_limited & accepted, WIDEN, 1.0) * radius
        shrunk = SHRINK * np.minimum(radius, size)
        radius = np.where(is_poor, shrunk, widened)
        self.radius = np.maximum(radius, MIN_RADIUS)[self.block]

    def limit(self) -> None:
        """Limit the radii to `SETTLE_RADIUS`."""
        self.radius = np.minimum(self.radius, SETTLE_RADIUS)

    def has_stalled(self, step: Floats, shortfall: Floats) -> bool:
        """Return whether the waypoints that lack clearance, if any, or else all no longer move.

        Args:
            step: Largest coordinate change at each waypoint, shape (N,) [m] or [rad].
            shortfall: Clearance violation at each waypoint, shape (N,) [m].
        """
        lacks_clearance = shortfall > CLEARANCE_TOLERANCE
        if not lacks_clearance.any():
            lacks_clearance[:] = True
        moves = np.minimum(self.radius, step)
        return bool((moves[lacks_clearance] < CLEARANCE_TOLERANCE).all())

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
    negligible = NEGLIGIBLE_MERIT_CHANGE * max(1.0, abs(merit))
    if predicted < negligible:
        return actual >= -negligible
    return actual > ACCEPTANCE_RATIO * predicted
