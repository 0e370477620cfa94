"""The exact ℓ1 merit function: what a motion costs, and what everything costs that does not hold yet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from vkc_pin.planning.chain.contacts import Contacts
from vkc_pin.planning.chain.pose import AWAY, away_from
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.nlp.timing import Timing
from vkc_pin.utils.arrays import Floats

__all__ = ["GROWTH", "TOLERANCE", "Infeasibility", "Merit", "infeasibility", "shortfalls"]

# [m], [rad] and, of rates, relative to their limits: besides clearance, what is missing of what
# holds
TOLERANCE = 1e-4
GROWTH = 4.0  # ratio of a weight to the one before, where it proved too small


@dataclass(frozen=True, eq=False)
class Infeasibility:
    """What does not hold along a motion.

    Attributes:
        amounts: For every kind of constraint, the sum of what is missing at every waypoint, shape
            (N,): "clearance" [m], "poses" (closure, goals and grasps: distance and angle) [m] and
            [rad], "rolling" [m], "clamped" [m] and [rad], "terms" (1e-3 is their tolerance),
            "rates" [m] and [rad].
        away: See `Transcription.parameter_vector`, shape (N, poses, 7).
        excess: Of rolling, clamping and own constraints, in the order of their rows.
        rate_excess: Of velocities and accelerations; empty if they are not rows of the program.
    """

    amounts: Mapping[str, Floats]
    away: Floats
    excess: Floats
    rate_excess: Floats

    @property
    def total(self) -> float:
        """All that is missing."""
        return float(sum(amount.sum() for amount in self.amounts.values()))

    @property
    def others(self) -> float:
        """The most that is missing of one kind at a waypoint, clearance aside."""
        return float(
            np.max([amount for kind, amount in self.amounts.items() if kind != "clearance"])
        )


def shortfalls(contacts: Contacts, segments: int, slots: int) -> Floats:
    """Return by how much the pairs that have witness planes fall short of their margins, shape (N, K) [m]."""
    plane = contacts.place
    kept = plane < slots
    found = np.zeros((segments, slots))
    found[contacts.waypoint[kept], plane[kept]] = np.maximum(
        contacts.margin[kept] - contacts.distance[kept], 0.0
    )
    return found


def infeasibility(
    problem: TrajectoryProblem, z: Floats, timing: Timing, contacts: Contacts, *, rates: bool
) -> Infeasibility:
    """Return what does not hold at z_1..z_N, shape (N, n).

    Args:
        problem: What is asked for.
        z: The waypoints.
        timing: How long steps take.
        contacts: What is close at the waypoints.
        rates: Whether limits on velocity and acceleration count.
    """
    t = problem.transcription
    amounts = {kind: np.zeros(len(z)) for kind in ("poses", "rolling", "clamped", "terms", "rates")}
    amounts["clearance"] = shortfalls(contacts, len(z), t.slots).sum(axis=1)
    away = np.zeros((len(z), len(problem.pose_goals), AWAY))
    rotations, translations = problem.chain.joint_placements(z)
    for k, goal in enumerate(problem.pose_goals):
        if goal.row.waypoints:
            at = np.array(goal.row.waypoints) - 1
            away[at, k] = away_from(
                goal.row.kind, *goal.row.placed(rotations[at], translations[at]), goal.target
            )
    amounts["poses"] = np.linalg.norm(away[:, :, :3], axis=2).sum(axis=1) + away[:, :, 6].sum(
        axis=1
    )
    excess = problem.excess(z, timing, rates=rates)
    for kind, scale in problem.row_kinds.items():
        np.add.at(amounts[kind], t.owners, scale * np.abs(excess))
    rate_excess = np.zeros(0)
    if rates:
        values = np.concatenate([part.ravel() for part in problem.rates(z)])
        bound = np.concatenate([timing.velocity.ravel(), timing.acceleration.ravel()])
        rate_excess = values - np.clip(values, -bound, bound)
        np.add.at(amounts["rates"], t.rate_owners, np.abs(rate_excess))
    return Infeasibility(amounts, away, excess, rate_excess)


class Merit:
    """φ(z) = f(z) + Σ_k ν_k Σ_t v_kt(z): f of eq. 1, and for kinds k of constraints their weights and `Infeasibility.amounts`.

    It is exact: where the weights exceed the multipliers, its minima are those of the program
    (Nocedal and Wright, Numerical Optimization, theorem 17.3).

    Attributes:
        weights: ν_k of every kind, [1/m] and [1/rad].
    """

    def __init__(self, weight: float) -> None:
        kinds = ("clearance", "poses", "rolling", "clamped", "terms", "rates")
        self.weights = dict.fromkeys(kinds, weight)

    def price(self, found: Infeasibility, *, clearance: bool) -> Floats:
        """Return what all that is missing costs at every waypoint, shape (N,), with or without clearance."""
        kinds = (kind for kind in self.weights if clearance or kind != "clearance")
        return np.asarray(sum(self.weights[kind] * found.amounts[kind] for kind in kinds))

    def grow(self, found: Infeasibility, tolerance: float) -> bool:
        """Make dearer what is still missing at some waypoint by more than `tolerance`; return whether anything is."""
        low = [kind for kind in self.weights if found.amounts[kind].max(initial=0.0) > tolerance]
        for kind in low:
            self.weights[kind] *= GROWTH
        return bool(low)
