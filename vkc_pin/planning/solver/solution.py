"""What the solver reports while it runs, and what it returns."""

from __future__ import annotations

from dataclasses import dataclass, field

from vkc_pin.utils.arrays import Floats

__all__ = ["Iteration", "Solution"]


@dataclass(frozen=True)
class Iteration:
    """One round of the witness-plane loop, as the callback sees it.

    Attributes:
        round: Counted from 1.
        iterations: Ipopt iterations so far.
        objective: f of eq. 1.
        clearance: Smallest distance at waypoints [m]; infinite if nothing is within reach.
        shortfall: What is missing to the clearance that is asked for [m].
        pose_error: Largest residual of closure and goals, [m] or [rad], and of own constraints,
            1e-3 being their tolerance.
        step: Largest change of a coordinate in this round.
        radius: Trust region of this round.
        penalty: Weight of the clearance slack.
        accepted: Whether the loop goes on from here, or tries a shorter step.
        time: Since the solver began [s].
    """

    round: int
    iterations: int
    objective: float
    clearance: float
    shortfall: float
    pose_error: float
    step: float
    radius: float
    penalty: float
    accepted: bool
    time: float


@dataclass
class Solution:
    """What the solver found; whether it is a success only `validation` can say.

    Attributes:
        z: z_1..z_N, shape (N, n), the best iterate.
        dt: Time of every step of it [s], shape (N,).
        converged: Whether the loop ended by its own criteria.
        status: "converged", "not converged", or one of `budget.ENDINGS`.
        astray: Of one that did not converge, by how much the worst pair at a waypoint falls short
            of its margin [m], if that is so much that `validation` cannot accept it; otherwise 0.
        radius: How far planes were believed in the end, shape (N,).
        rounds, iterations: Of the outer loop and of Ipopt.
        timings: Seconds in "coal", "casadi" (evaluation_time functions) and "ipopt" (all the rest of
            it).
        history: One `Iteration` per round.
    """

    z: Floats
    dt: Floats
    converged: bool = False
    status: str = "not converged"
    astray: float = 0.0
    radius: Floats | None = None
    rounds: int = 0
    iterations: int = 0
    timings: dict[str, float] = field(
        default_factory=lambda: {"coal": 0.0, "casadi": 0.0, "ipopt": 0.0}
    )
    history: list[Iteration] = field(default_factory=list)
