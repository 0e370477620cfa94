"""Computes the exact ℓ1 merit function: the objective plus weighted constraint violations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from vkc_pin.planning.chain.contacts import Contacts
from vkc_pin.planning.chain.pose import POSE_OFFSET_SIZE, compute_pose_offsets
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.nlp.timing import Timing
from vkc_pin.utils.arrays import Floats

# [m], [rad], and relative to the limits for rates: tolerance of all constraints except clearance
TOLERANCE = 1e-4
GROWTH = 4.0  # factor by which a weight grows if it proved too small
MAX_WEIGHT = 1000.0  # [1/m], [1/rad] beyond which a violation is taken for unavoidable


@dataclass(frozen=True, eq=False)
class Infeasibility:
    """Constraint violations along a motion.

    Attributes:
        amounts: For each kind of constraint, the summed violation at each waypoint, shape (N,):
            "clearance" [m], "poses" (closure, goals and grasps: distance and angle) [m] and [rad],
            "rolling" [m], "clamped" [m] and [rad], "terms" (1e-3 is their tolerance), "rates" [m]
            and [rad].
        pose_offsets: See `Transcription.parameter_vector`, shape (N, poses, 7).
        excess: Bound violations of rolling, clamping and user-defined rows, in the order of the
            rows.
        rate_excess: Bound violations of velocities and accelerations; empty if they are not rows of
            the program.
    """

    amounts: Mapping[str, Floats]
    pose_offsets: Floats
    excess: Floats
    rate_excess: Floats

    @property
    def total(self) -> float:
        """Sum of all violations."""
        return float(sum(amount.sum() for amount in self.amounts.values()))

    @property
    def max_violation(self) -> float:
        """Largest violation of one kind at a waypoint, except clearance."""
        others = [amount for kind, amount in self.amounts.items() if kind != "clearance"]
        return float(np.max(others))


def compute_shortfalls(contacts: Contacts, segments: int, slots: int) -> Floats:
    """Return the clearance shortfall of the pairs with witness planes, shape (N, K) [m]."""
    shortfalls = np.zeros((segments, slots))
    slot = contacts.slot
    has_plane = slot < slots
    amounts = np.maximum((contacts.margin - contacts.distance)[has_plane], 0.0)
    shortfalls[contacts.waypoint[has_plane], slot[has_plane]] = amounts
    return shortfalls


def measure_infeasibility(
    problem: TrajectoryProblem, z: Floats, timing: Timing, contacts: Contacts, *, rates: bool
) -> Infeasibility:
    """Return the constraint violations at z_1..z_N, shape (N, n), with their contacts.

    The violation of kind j at waypoint t, v_jt, is for "clearance" the sum of (margin − distance)⁺
    over the pairs with planes, for "poses" that of ‖p − p*‖ + θ over the goals, and for all other
    kinds that of the distances of rows from their bounds. Velocity and acceleration limits count
    only with `rates`.
    """
    t = problem.transcription
    amounts = {kind: np.zeros(len(z)) for kind in ("poses", "rolling", "clamped", "terms", "rates")}
    amounts["clearance"] = compute_shortfalls(contacts, len(z), t.slots).sum(axis=1)
    pose_offsets = _compute_pose_offsets(problem, z)
    distances = np.linalg.norm(pose_offsets[:, :, :3], axis=2)
    angles = pose_offsets[:, :, 6]
    amounts["poses"] = distances.sum(axis=1) + angles.sum(axis=1)
    excess = problem.excess(z, timing, rates=rates)
    for kind, scale in problem.row_kinds.items():
        np.add.at(amounts[kind], t.row_waypoints, scale * np.abs(excess))
    rate_excess = np.zeros(0)
    if rates:
        steps, changes = problem.rates(z, timing.dt)
        values = np.concatenate([steps.ravel(), changes.ravel()])
        bound = np.concatenate([timing.velocity.ravel(), timing.acceleration.ravel()])
        rate_excess = values - np.clip(values, -bound, bound)
        np.add.at(amounts["rates"], t.rate_waypoints, np.abs(rate_excess))
    return Infeasibility(amounts, pose_offsets, excess, rate_excess)


def _compute_pose_offsets(problem: TrajectoryProblem, z: Floats) -> Floats:
    """Return the offset of each pose goal where it applies, else zero, shape (N, poses, 7)."""
    pose_offsets = np.zeros((len(z), len(problem.pose_goals), POSE_OFFSET_SIZE))
    rotations, translations = problem.chain.joint_placements(z)
    for k, goal in enumerate(problem.pose_goals):
        if not goal.row.waypoints:
            continue
        at = np.array(goal.row.waypoints) - 1
        rotation, translation = goal.row.compute_placements(
            rotations[at], translations[at], goal.local
        )
        pose_offsets[at, k] = compute_pose_offsets(
            goal.row.kind, rotation, translation, goal.target
        )
    return pose_offsets


class Merit:
    """The merit function φ(z) = f(z) + Σ_k ν_k Σ_t v_kt(z), with f of eq. 1.

    ν_k and v_k are the weight and `Infeasibility.amounts` of constraint kind k. φ is exact: if the
    weights exceed the multipliers, its minima are those of the program (Nocedal and Wright,
    Numerical Optimization, theorem 17.3).

    Attributes:
        weights: ν_k of each kind, [1/m] and [1/rad].
    """

    def __init__(self, weight: float) -> None:
        kinds = ("clearance", "poses", "rolling", "clamped", "terms", "rates")
        self.weights = dict.fromkeys(kinds, weight)

    def compute_penalty(self, infeasibility: Infeasibility, *, clearance: bool) -> Floats:
        """Return the penalty at each waypoint, shape (N,), with or without clearance."""
        penalties = []
        for kind, weight in self.weights.items():
            if clearance or kind != "clearance":
                penalties.append(weight * infeasibility.amounts[kind])
        return np.asarray(sum(penalties))

    def increase_weights(self, infeasibility: Infeasibility, clearance_tolerance: float) -> bool:
        """Increase the weights of violated kinds; return whether any increased.

        A kind is violated where the solution would not be accepted: clearance above
        `clearance_tolerance` [m], every other kind above `TOLERANCE`.
        """
        is_any_increased = False
        for kind, weight in self.weights.items():
            tolerance = clearance_tolerance if kind == "clearance" else TOLERANCE
            largest = infeasibility.amounts[kind].max(initial=0.0)
            if largest > tolerance and weight < MAX_WEIGHT:
                self.weights[kind] = GROWTH * weight
                is_any_increased = True
        return is_any_increased
