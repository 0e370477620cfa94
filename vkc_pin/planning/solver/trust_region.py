"""Trials and the trust region: how far the witness planes are believed, and how that is learned from round to round."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vkc_pin.planning.chain.contacts import Contacts
from vkc_pin.planning.nlp.merit import Infeasibility
from vkc_pin.planning.solver.tunnelling import Passage
from vkc_pin.utils.arrays import Floats

__all__ = ["Trial", "TrustRegion", "judge"]

BLOCK_TIME = 2.5  # [s] of motion that share a radius, at `Options.dt` a waypoint
FIRST_RADIUS = 0.5  # [m] and [rad] of the trust region at first, and after weights have grown
# share of the radius: steps that end within it were not held back (Ipopt ends a little inside its
# bounds)
INSIDE = 0.9
SETTLE_RADIUS = 0.05  # [m] and [rad] in which planes are as good as distances
SHRINK = 0.4  # of the radius, or of the step if that was shorter, where a promise did not come true
NO_MATTER = 0.4  # of the merit, in a block: 8 mm of shortfall at the weight that it has at first
# [m] shortfall at a waypoint, clearance between waypoints, and steps ([rad], too), that do not
# matter
CLOSE_ENOUGH = 5e-4


@dataclass(frozen=True)
class Trial:
    """Where a round led, one Ipopt solve with fixed planes, and what is really there.

    Attributes:
        z: z_1..z_N, shape (N, n).
        promise: What all that is missing would cost at every waypoint, were the planes the
            distances, shape (N,).
        objective: f of eq. 1.
        pose_error: Largest residual, see `TrajectoryProblem.row_error`.
        found: What does not hold there.
        contacts: What is close there.
        clear: Whether everything is far enough from each other, between waypoints, too.
        passages: What goes through each other between waypoints.
        rate: Largest excess over a limit on velocity or acceleration, relative to it.
        step: The largest change of a coordinate at every waypoint, shape (N,).
        satisfied: Whether Ipopt was.
    """

    z: Floats
    promise: Floats
    objective: float
    pose_error: float
    found: Infeasibility
    contacts: Contacts
    clear: bool
    passages: list[Passage]
    rate: float
    step: Floats
    satisfied: bool


class TrustRegion:
    """How far waypoints may move in a round: the same for all of a block, so that trouble in one place does not hold up others.

    Args:
        segments: N, the number of waypoints.
        length: How many of them make a block, about.
        radius: Of each waypoint at first, shape (N,) [m] and [rad]; None: `FIRST_RADIUS`.

    Attributes:
        block: The block of each waypoint, shape (N,).
        radius: Of each waypoint, shape (N,) [m] and [rad].
    """

    def __init__(self, segments: int, length: int, radius: Floats | None = None) -> None:
        self.block = np.arange(segments) * max(1, round(segments / length)) // segments
        self.radius = np.full(segments, FIRST_RADIUS) if radius is None else radius.copy()

    def adapt(self, before: Floats, after: Floats, trial: Trial, accepted: bool) -> None:
        """Widen blocks where what was promised came true, narrow those where it did not.

        Args:
            before: What all that is missing cost at every waypoint before the round, shape (N,).
            after: What it costs now.
            trial: Where the round led.
            accepted: Whether it goes on from there.
        """
        blocks = int(self.block[-1]) + 1
        promised, actual, step = np.zeros(blocks), np.zeros(blocks), np.zeros(blocks)
        np.add.at(promised, self.block, before - trial.promise)
        np.add.at(actual, self.block, before - after)
        np.maximum.at(step, self.block, trial.step)
        worse = (promised - actual > NO_MATTER) & (actual < 0.25 * promised)
        if not accepted and not worse.any():
            worse[:] = True
        radius = np.array([self.radius[self.block == b][0] for b in range(blocks)])
        good = (actual > 0.7 * promised - NO_MATTER) & accepted & (step > INSIDE * radius)
        factor = np.where(good, 1.5, 1.0)
        radius = np.where(worse, SHRINK * np.minimum(radius, step), radius * factor)
        self.radius = np.maximum(radius, 1e-6)[self.block]

    def settle(self) -> None:
        """Let waypoints move so little that planes are as good as distances."""
        self.radius = np.minimum(self.radius, SETTLE_RADIUS)

    def stuck(self, trial: Trial, shortfall: Floats) -> bool:
        """Return whether nothing moves any more, by what is close enough, where something is in the way."""
        bad = shortfall > CLOSE_ENOUGH
        if not bad.any():
            bad[:] = True
        return bool((np.minimum(self.radius, trial.step)[bad] < CLOSE_ENOUGH).all())

    def restart(self) -> None:
        """Begin again."""
        self.radius = np.full(len(self.radius), FIRST_RADIUS)


def judge(promised: float, actual: float, merit: float) -> bool:
    """Return whether to accept where a round led.

    Args:
        promised: The decrease that the planes promised.
        actual: What came of it.
        merit: The merit before.
    """
    negligible = 1e-4 * max(1.0, abs(merit))
    if promised < negligible:
        return actual >= -negligible
    return actual > 0.05 * promised
