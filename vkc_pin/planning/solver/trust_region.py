"""Adapts the trust-region radius of each waypoint to the ratio of actual to predicted reduction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vkc_pin.planning.chain.contacts import Contacts
from vkc_pin.planning.nlp.merit import Infeasibility
from vkc_pin.planning.solver.tunnelling import Crossing
from vkc_pin.utils.arrays import Floats

__all__ = ["Trial", "TrustRegion", "is_step_acceptable"]

BLOCK_TIME = 2.5  # [s] of motion that share a radius, at one waypoint per `Options.dt`
FIRST_RADIUS = 0.5  # [m], [rad] initial radius, also after the penalty weights were raised
# fraction of the radius above which a step counts as limited by the trust region (Ipopt ends a
# little inside its bounds)
ACTIVE_FRACTION = 0.9
SETTLE_RADIUS = 0.05  # [m], [rad] within which the planes approximate the distances well
SHRINK = 0.4  # factor on the smaller of radius and step where the prediction was poor
# merit change in a block that is ignored: 8 mm of shortfall at the initial penalty weight
NEGLIGIBLE_CHANGE = 0.4
# [m] shortfall at a waypoint, clearance within segments, and steps (also [rad]) that are negligible
CLEARANCE_TOLERANCE = 5e-4


@dataclass(frozen=True)
class Trial:
    """Trial point of a round: the solution of the subproblem with fixed planes, evaluated exactly.

    Attributes:
        z: z_1..z_N, shape (N, n).
        predicted_penalty: Penalty at each waypoint that the subproblem predicts, shape (N,).
        objective: f of eq. 1.
        pose_error: Largest residual, see `TrajectoryProblem.row_error`.
        infeasibility: Constraint violations.
        contacts: Close pairs.
        is_clear: Whether all clearances hold, also within segments.
        crossings: Pairs that pass through each other between waypoints.
        rate_excess: Largest violation of a velocity or acceleration limit, relative to the limit.
        step: Largest coordinate change at each waypoint, shape (N,) [m] or [rad].
        succeeded: Whether Ipopt reported success.
    """

    z: Floats
    predicted_penalty: Floats
    objective: float
    pose_error: float
    infeasibility: Infeasibility
    contacts: Contacts
    is_clear: bool
    crossings: list[Crossing]
    rate_excess: float
    step: Floats
    succeeded: bool


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

    def adapt(self, before: Floats, after: Floats, trial: Trial, accepted: bool) -> None:
        """Widen blocks in which the prediction was good, shrink those in which it was poor.

        Args:
            before: Penalties of the iterate, shape (N,).
            after: Penalties of the trial, shape (N,).
            trial: Trial point.
            accepted: Whether the trial was accepted.
        """
        blocks = int(self.block[-1]) + 1
        predicted, actual, step = np.zeros(blocks), np.zeros(blocks), np.zeros(blocks)
        np.add.at(predicted, self.block, before - trial.predicted_penalty)
        np.add.at(actual, self.block, before - after)
        np.maximum.at(step, self.block, trial.step)
        poor = (predicted - actual > NEGLIGIBLE_CHANGE) & (actual < 0.25 * predicted)
        if not accepted and not poor.any():
            poor[:] = True
        radius = np.array([self.radius[self.block == b][0] for b in range(blocks)])
        good = (
            (actual > 0.7 * predicted - NEGLIGIBLE_CHANGE)
            & accepted
            & (step > ACTIVE_FRACTION * radius)
        )
        factor = np.where(good, 1.5, 1.0)
        radius = np.where(poor, SHRINK * np.minimum(radius, step), radius * factor)
        self.radius = np.maximum(radius, 1e-6)[self.block]

    def limit(self) -> None:
        """Limit the radii to `SETTLE_RADIUS`, within which the planes are accurate."""
        self.radius = np.minimum(self.radius, SETTLE_RADIUS)

    def has_stalled(self, trial: Trial, shortfall: Floats) -> bool:
        """Return whether the waypoints that lack clearance no longer move.

        Args:
            trial: Last trial point.
            shortfall: Clearance violation at each waypoint, shape (N,) [m].
        """
        violated = shortfall > CLEARANCE_TOLERANCE
        if not violated.any():
            violated[:] = True
        return bool((np.minimum(self.radius, trial.step)[violated] < CLEARANCE_TOLERANCE).all())

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
