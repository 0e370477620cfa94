"""Defines the records of the solver: one per round, and the solution."""

from __future__ import annotations

from dataclasses import dataclass, field

from vkc_pin.utils.arrays import Floats


@dataclass(frozen=True)
class Iteration:
    """One round of the witness-plane loop, as passed to the callback.

    Attributes:
        round: Number of the round, from 1.
        iterations: Ipopt iterations so far.
        objective: f of eq. 1.
        clearance: Smallest distance at waypoints [m]; infinite if nothing is within reach.
        shortfall: Largest violation of a required clearance [m].
        pose_error: Largest residual of closures and goals, [m] or [rad], and of user constraints,
            scaled to a tolerance of 1e-3.
        step: Largest coordinate change in this round [m] or [rad].
        radius: Largest trust-region radius of this round [m] or [rad].
        penalty: Penalty weight of the clearance slacks [1/m].
        accepted: Whether the step was accepted.
        time: Time since the solver started [s].
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
    """Result of the solver. Only `validation` decides whether it is a success.

    Attributes:
        z: Best iterate z_1..z_N, shape (N, n).
        dt: Its time steps, shape (N,) [s].
        converged: Whether the loop met its own convergence criteria.
        status: "converged", "not converged", or one of `budget.STOP_STATUSES`.
        shortfall: Largest clearance violation at a waypoint [m] of a solution that did not
            converge, if it is too large for `validation` to accept; otherwise 0.
        radius: Final trust-region radii, shape (N,) [m] or [rad].
        rounds, iterations: Numbers of outer rounds and of Ipopt iterations.
        timings: Time in "coal", "casadi" (function evaluation) and "ipopt" (the rest of Ipopt) [s].
        history: One `Iteration` per round.
    """

    z: Floats
    dt: Floats
    converged: bool = False
    status: str = "not converged"
    shortfall: float = 0.0
    radius: Floats | None = None
    rounds: int = 0
    iterations: int = 0
    timings: dict[str, float] = field(
        default_factory=lambda: {"coal": 0.0, "casadi": 0.0, "ipopt": 0.0}
    )
    history: list[Iteration] = field(default_factory=list)
