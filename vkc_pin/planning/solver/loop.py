"""Runs the witness-plane loop: trust-region subproblems with an exact ℓ1 merit function."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from vkc_pin.planning.chain.contacts import Contacts
from vkc_pin.planning.nlp.merit import TOLERANCE, Infeasibility, Merit, measure_infeasibility
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.solver.segment_planes import find_segment_contacts, merge_contacts
from vkc_pin.planning.solver.solution import Iteration, Solution
from vkc_pin.planning.solver.subproblem import Subproblem
from vkc_pin.planning.solver.trust_region import (
    ACTIVE_FRACTION,
    BLOCK_TIME,
    CLEARANCE_TOLERANCE,
    Trial,
    TrustRegion,
    is_step_acceptable,
)
from vkc_pin.planning.solver.tunnelling import Crossing, find_new_crossings
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.budget import STOP_STATUSES, BudgetExhaustedError, record_evaluations

__all__ = ["solve"]

# [m], [rad] violation of clearance, or of closures, goals and grasps, up to which a trajectory
# counts as nearly feasible
NEARLY_FEASIBLE = 0.01
# rounds within which the infeasibility must decrease; near feasibility only accepted rounds count
PROGRESS_ROUNDS = 5
PROGRESS = 0.7  # factor by which the infeasibility must decrease in these rounds
MIN_IMPROVEMENT = 0.05  # relative decrease of the objective that justifies further rounds


class _Loop:
    """State between rounds: waypoints, contacts, infeasibility and penalty weights."""

    def __init__(self, problem: TrajectoryProblem, guess: Floats, weight: float) -> None:
        self.problem, self.options = problem, problem.options
        self.z = problem.clip(guess)
        self.timing = problem.timing_for(self.z)
        self.rates = False
        self.merit = Merit(weight)
        self.solution = Solution(self.z, self.timing.dt)
        self.subproblem = Subproblem(problem, self.solution)
        # The last feasible waypoints and their time steps.
        self.feasible: tuple[Floats, Floats] | None = None

    def begin(self) -> None:
        """Evaluate contacts, infeasibility and objective at the initial guess."""
        self.at, _, self.crossings = self.find_contacts(self.z)
        self.evaluate_iterate()

    def evaluate_iterate(self) -> None:
        """Evaluate infeasibility, objective and pose error at the current waypoints."""
        self.found = self.compute_infeasibility(self.z, self.at)
        self.objective = self.problem.objective(self.z, self.timing.dt)
        self.pose_error = self.problem.row_error(self.z, self.timing.dt)

    def compute_infeasibility(self, z: Floats, at: Contacts) -> Infeasibility:
        """Return the constraint violations at waypoints, shape (N, n), with given contacts."""
        return measure_infeasibility(self.problem, z, self.timing, at, rates=self.rates)

    def find_contacts(self, z: Floats) -> tuple[Contacts, bool, list[Crossing]]:
        """Find contacts at waypoints and within segments.

        Args:
            z: z_1..z_N, shape (N, n).

        Returns:
            Contacts; whether all clearances hold; pairs that pass through each other.
        """
        begin = time.perf_counter()
        found = self.problem.evaluate_contacts(
            z, reach=self.options.contact_reach, nearest=self.options.contact_slots
        )
        segments = find_segment_contacts(self.problem, z)
        self.solution.timings["coal"] += time.perf_counter() - begin
        is_clear = segments.is_free and found.compute_violation() < CLEARANCE_TOLERANCE
        return merge_contacts(found, segments.contacts), is_clear, segments.crossings

    def try_step(self, radius: Floats) -> Trial:
        """Solve the subproblem within `radius`, shape (N,), and evaluate the trial point."""
        z, slack, relaxation, succeeded = self.subproblem.solve(
            self.z, self.at, self.found, self.merit, self.timing, radius, rates=self.rates
        )
        contacts, is_clear, crossings = self.find_contacts(z)
        predicted_penalty = (
            self.merit.weights["clearance"] * slack
            + self.merit.compute_penalty(self.found, clearance=False) * relaxation
        )
        return Trial(
            z=z,
            predicted_penalty=predicted_penalty,
            objective=self.problem.objective(z, self.timing.dt),
            pose_error=self.problem.row_error(z, self.timing.dt),
            infeasibility=self.compute_infeasibility(z, contacts),
            contacts=contacts,
            is_clear=is_clear,
            crossings=crossings,
            rate_excess=self.timing.compute_violation(*self.problem.pace(z)),
            step=np.abs(z - self.z).max(axis=1),
            succeeded=succeeded,
        )

    def compute_penalties(self, trial: Trial) -> tuple[Floats, Floats]:
        """Return the penalty at each waypoint for iterate and trial, shape (N,) each.

        The trial's penalty is infinite where a pair newly passes through each other, once the poses
        are nearly feasible. Before, the waypoints do not describe a motion yet.
        """
        before, after = (
            self.merit.compute_penalty(found, clearance=True)
            for found in (self.found, trial.infeasibility)
        )
        if self.found.amounts["poses"].max() < NEARLY_FEASIBLE:
            for crossing in find_new_crossings(trial.crossings, self.crossings):
                after[max(crossing.first - 1, 0) : crossing.last + 1] = np.inf
        return before, after

    def is_acceptable(self, trial: Trial, before: Floats, after: Floats) -> bool:
        """Return whether the actual merit reduction is large enough to accept a step.

        Args:
            trial: Trial point.
            before: Penalties of the iterate, shape (N,); see `compute_penalties`.
            after: Penalties of the trial, shape (N,).
        """
        penalty, gain = float(before.sum()), self.objective - trial.objective
        return is_step_acceptable(
            gain + penalty - float(trial.predicted_penalty.sum()),
            gain + penalty - float(after.sum()),
            self.objective + penalty,
        )

    def accept(self, trial: Trial) -> None:
        """Make `trial` the iterate; adapt time steps and rate limits to it."""
        was_infeasible = self.found.max_violation > TOLERANCE
        self.z, self.at, self.found, self.crossings = (
            trial.z,
            trial.contacts,
            trial.infeasibility,
            trial.crossings,
        )
        self.objective, self.pose_error = trial.objective, trial.pose_error
        self.solution.z = trial.z
        # Infeasible waypoints are a poor estimate of how long the motion takes.
        if was_infeasible and not self.rates:
            self.timing = self.problem.timing_for(self.z)
            self.solution.dt = self.timing.dt
            self.evaluate_iterate()
        nearly_clear = trial.contacts.compute_violation() < NEARLY_FEASIBLE
        if nearly_clear and trial.rate_excess > TOLERANCE:  # earlier, rate limits only cost time
            pace = self.problem.pace(trial.z)
            self.timing = self.timing.stretch(*pace)
            self.solution.dt = self.timing.dt
            if not self.rates and self.timing.compute_violation(*pace) > TOLERANCE:
                self.rates = True
                self.subproblem.reset_multipliers()
            self.evaluate_iterate()

    def has_converged(self, trial: Trial) -> bool:
        """Return whether an accepted trial satisfies all constraints, also within segments."""
        return (
            trial.succeeded
            and trial.is_clear
            and self.pose_error < TOLERANCE
            and self.timing.compute_violation(*self.problem.pace(trial.z)) <= TOLERANCE
        )

    def raise_penalties(self) -> bool:
        """Raise the penalty weights of violated constraints; return whether any was raised."""
        self.subproblem.reset_multipliers()
        return self.merit.increase_weights(self.found, CLEARANCE_TOLERANCE)


def solve(
    problem: TrajectoryProblem,
    guess: Floats,
    *,
    callback: Callable[[Iteration], None] | None = None,
    rounds: int | None = None,
    radius: Floats | None = None,
) -> Solution:
    """Solve a problem with the witness-plane loop, starting from an initial guess.

    Args:
        problem: Problem to solve.
        guess: Initial guess z_1..z_N, shape (N, n).
        callback: Called after every round.
        rounds: Maximum number of rounds. Default: `Options.max_outer`.
        radius: Initial trust-region radius at each waypoint, shape (N,) [m] or [rad]. Pass
            `Solution.radius` to continue another solution.

    Returns:
        The solution, or the best iterate when the budget is exhausted.
    """
    loop = _Loop(problem, guess, problem.options.penalty)
    solution = loop.solution
    region = TrustRegion(problem.segments, problem.options.steps(BLOCK_TIME), radius)
    try:
        loop.begin()
        _iterate(loop, region, callback, loop.options.max_outer if rounds is None else rounds)
    except BudgetExhaustedError as end:
        solution.status = "converged" if solution.converged else str(end)
    # Rounds after the first feasible one only try to shorten the trajectory.
    if loop.feasible is not None:
        solution.z, solution.dt = loop.feasible
    elif solution.status not in STOP_STATUSES:
        shortfall = problem.evaluate_contacts(
            solution.z, reach=problem.options.largest_margin, nearest=1
        ).compute_violation()
        solution.shortfall = shortfall if shortfall > NEARLY_FEASIBLE else 0.0
    solution.radius = region.radius
    return solution


def _iterate(
    loop: _Loop, region: TrustRegion, callback: Callable[[Iteration], None] | None, rounds: int
) -> None:
    """Run rounds until the trajectory is feasible and short, or progress stalls."""
    solution, started = loop.solution, time.perf_counter()
    reference, since = loop.found.total, 0  # infeasibility when rounds were last counted
    shortfall, nearly = loop.found.amounts["clearance"], _is_nearly_feasible(loop.found)
    best = float("inf")  # objective of the last feasible trajectory
    for _ in range(rounds):
        record_evaluations()
        trial = loop.try_step(region.radius)
        before, after = loop.compute_penalties(trial)
        accepted = loop.is_acceptable(trial, before, after)
        solution.rounds += 1
        row = Iteration(
            round=solution.rounds,
            iterations=solution.iterations,
            objective=trial.objective,
            clearance=trial.contacts.compute_clearance(),
            shortfall=trial.contacts.compute_violation(),
            pose_error=trial.pose_error,
            step=float(trial.step.max()),
            radius=float(region.radius.max()),
            penalty=loop.merit.weights["clearance"],
            accepted=accepted,
            time=time.perf_counter() - started,
        )
        solution.history.append(row)
        if callback is not None:
            callback(row)
        used = region.radius
        if accepted:
            last = loop.objective if nearly else best
            loop.accept(trial)
            if converged := loop.has_converged(trial):
                best = trial.objective
                # Waypoints that are too far apart on an arc cannot be repaired by more rounds.
                if loop.problem.drift(trial.z) <= 1.0:
                    solution.converged, solution.status, loop.feasible = (
                        True,
                        "converged",
                        (trial.z, solution.dt),
                    )
                improved = best < (1.0 - MIN_IMPROVEMENT) * last
                if not improved or (trial.step < ACTIVE_FRACTION * used).all():
                    break
        region.adapt(before, after, trial, accepted)
        # Near feasibility, rejected rounds are not counted: they shrink the radius, which ends the
        # loop by itself.
        since += accepted or shortfall.max() >= NEARLY_FEASIBLE
        # The infeasibility may also grow, where the objective decreased instead.
        if not PROGRESS * reference < loop.found.total <= reference:
            reference, since = loop.found.total, 0
        if since >= PROGRESS_ROUNDS:
            break
        shortfall, nearly = loop.found.amounts["clearance"], _is_nearly_feasible(loop.found)
        if accepted and not converged and nearly:
            region.limit()
        if region.has_stalled(trial, shortfall):
            if shortfall.max() >= NEARLY_FEASIBLE or not loop.raise_penalties():
                break
            region.reset()


def _is_nearly_feasible(found: Infeasibility) -> bool:
    """Return whether all constraints hold except for a small clearance violation."""
    return (
        bool(found.amounts["clearance"].max() < NEARLY_FEASIBLE) and found.max_violation < TOLERANCE
    )
