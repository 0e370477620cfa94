"""Runs the witness-plane loop: trust-region subproblems with an exact ℓ1 merit function."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vkc_pin.planning.chain.contacts import Contacts
from vkc_pin.planning.nlp.merit import (
    TOLERANCE,
    Infeasibility,
    Merit,
    compute_shortfalls,
    measure_infeasibility,
)
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.solver.segment_planes import (
    SegmentContacts,
    find_new_crossings,
    find_segment_contacts,
    merge_contacts,
)
from vkc_pin.planning.solver.separation import Separation
from vkc_pin.planning.solver.solution import Iteration, Solution
from vkc_pin.planning.solver.subproblem import Step, Subproblem
from vkc_pin.planning.solver.trust_region import (
    ACTIVE_FRACTION,
    BLOCK_TIME,
    CLEARANCE_TOLERANCE,
    TrustRegion,
    is_step_acceptable,
)
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.budget import STOP_STATUSES, BudgetExhaustedError, record_evaluations

# [m], [rad] violation of clearance, or of closures, goals and grasps, up to which a trajectory
# counts as nearly feasible
NEARLY_FEASIBLE = 0.01
# rounds within which the infeasibility must decrease; near feasibility only accepted rounds count
PROGRESS_ROUNDS = 5
PROGRESS = 0.7  # factor by which the infeasibility must decrease in these rounds
# relative decrease of the objective that justifies further rounds, from a guess and a solution
MIN_IMPROVEMENT = 0.05
MIN_CONTINUED_IMPROVEMENT = 0.01

Callback = Callable[[Iteration], None]


@dataclass
class _Point:
    """Waypoints z_1..z_N, shape (N, n), and their evaluation, also within segments."""

    z: Floats
    at: Contacts  # coal's, at the waypoints
    between: SegmentContacts
    contacts: Contacts  # all of them, those of penetrating stretches in one direction
    infeasibility: Infeasibility
    objective: float
    pose_error: float

    @property
    def shortfall(self) -> Floats:
        """Clearance violation at each waypoint, shape (N,) [m]."""
        return self.infeasibility.amounts["clearance"]

    @property
    def is_clear(self) -> bool:
        """Whether no pair lacks clearance at or between waypoints."""
        return self.between.is_free and self.at.compute_violation() < CLEARANCE_TOLERANCE

    @property
    def is_nearly_feasible(self) -> bool:
        """Whether all constraints hold except for a small clearance violation."""
        is_nearly_clear = bool(self.shortfall.max() < NEARLY_FEASIBLE)
        return is_nearly_clear and self.infeasibility.max_violation < TOLERANCE


class _Loop:
    """State between rounds: iterate, timing, penalty weights and trust region."""

    def __init__(self, problem: TrajectoryProblem, guess: Floats, radius: Floats | None) -> None:
        z = problem.clip(guess)
        self.problem = problem
        self.timing = problem.timing_for(z)
        self.rates = False  # whether velocity and acceleration limits are constraints
        self.merit = Merit(problem.options.penalty)
        self.solution = Solution(z, self.timing.dt)
        self.subproblem = Subproblem(problem, self.solution)
        self.region = TrustRegion(problem.segments, problem.options.steps(BLOCK_TIME), radius)
        self.separation = Separation(problem)
        self.improvement = MIN_IMPROVEMENT if radius is None else MIN_CONTINUED_IMPROVEMENT
        self.feasible: tuple[Floats, Floats] | None = None  # last feasible waypoints and time steps

    def run(self, callback: Callback, rounds: int) -> None:
        """Run rounds until the trajectory is feasible and short, or progress stalls."""
        solution = self.solution
        region = self.region
        started = time.perf_counter()
        self._set_point(self._evaluate(solution.z))
        reference = self._measure_total()  # when rounds were last counted
        rounds_without_progress = 0
        best = float("inf")  # objective of the last feasible trajectory
        for _ in range(rounds):
            record_evaluations()
            radius = region.radius
            point = self.point
            was_nearly_feasible = point.is_nearly_feasible
            lacked_clearance = point.shortfall.max() >= NEARLY_FEASIBLE
            step = self.subproblem.solve(
                point.z,
                point.contacts,
                point.infeasibility,
                self.merit,
                self.timing,
                radius,
                rates=self.rates,
            )
            trial = self._evaluate(step.z)
            size = np.abs(step.z - point.z).max(axis=1)
            predicted, actual, accepted = self._judge(step, trial)
            row = self._record_round(trial, size, radius, accepted, started)
            callback(row)
            converged = False
            if accepted:
                last = point.objective if was_nearly_feasible else best
                self._accept(trial)
                converged = step.succeeded and self._is_feasible()
            if converged:
                best = row.objective
                solution.converged = True
                solution.status = "converged"
                self.feasible = (trial.z, solution.dt)
                has_improved = best < (1.0 - self.improvement) * last
                is_inside_region = (size < ACTIVE_FRACTION * radius).all()
                if is_inside_region or not has_improved:
                    break
            region.adapt(predicted, actual, size, accepted)
            # Near feasibility, rejected rounds are not counted: they shrink the radius, which ends
            # the loop by itself.
            if accepted or lacked_clearance:
                rounds_without_progress += 1
            # The infeasibility may also grow, where the objective decreased instead.
            total = self._measure_total()
            is_similar = PROGRESS * reference < total <= reference
            if not is_similar:
                reference = total
                rounds_without_progress = 0
            if rounds_without_progress >= PROGRESS_ROUNDS:
                break
            if accepted and not converged and self.point.is_nearly_feasible:
                region.limit()
            if region.has_stalled(size, self.point.shortfall):
                if not self._raise_penalties():
                    break
            elif accepted and was_nearly_feasible and step.slack.max() > CLEARANCE_TOLERANCE:
                # A weight is too small if violations pay even according to the model.
                self._increase_weights()

    def _record_round(
        self, trial: _Point, size: Floats, radius: Floats, accepted: bool, started: float
    ) -> Iteration:
        """Append a row to the history of the solution, and return it."""
        solution = self.solution
        solution.rounds += 1
        row = Iteration(
            round=solution.rounds,
            iterations=solution.iterations,
            objective=trial.objective,
            clearance=trial.contacts.compute_clearance(),
            shortfall=trial.contacts.compute_violation(),
            pose_error=trial.pose_error,
            step=float(size.max()),
            radius=float(radius.max()),
            penalty=self.merit.weights["clearance"],
            accepted=accepted,
            time=time.perf_counter() - started,
        )
        solution.history.append(row)
        return row

    def _raise_penalties(self) -> bool:
        """Raise the weights of violated constraints near feasibility; return whether any rose."""
        if self.point.shortfall.max() >= NEARLY_FEASIBLE:
            return False
        self.region.reset()
        return self._increase_weights()

    def _increase_weights(self) -> bool:
        self.subproblem.reset_multipliers()
        return self.merit.increase_weights(self.point.infeasibility, CLEARANCE_TOLERANCE)

    def _evaluate(self, z: Floats) -> _Point:
        options = self.problem.options
        begin = time.perf_counter()
        at = self.problem.evaluate_contacts(
            z, reach=options.contact_reach, nearest=options.contact_slots
        )
        between = find_segment_contacts(self.problem, z)
        self.solution.timings["coal"] += time.perf_counter() - begin
        return self._make_point(z, at, between)

    def _make_point(self, z: Floats, at: Contacts, between: SegmentContacts) -> _Point:
        contacts = self.separation.replace_contacts(z, at, between.contacts)
        infeasibility, objective, pose_error = self._measure(z, contacts)
        return _Point(z, at, between, contacts, infeasibility, objective, pose_error)

    def _measure_total(self) -> float:
        """Return the sum of all violations of the iterate, whatever the directions of stretches."""
        point = self.point
        total = point.infeasibility.total
        if not self.separation.is_active:
            return total
        t = self.problem.transcription
        contacts = merge_contacts(point.at, point.between.contacts)
        shortfalls = compute_shortfalls(contacts, t.segments, t.slots)
        return total + float(shortfalls.sum() - point.shortfall.sum())

    def _set_point(self, point: _Point) -> None:
        """Make `point` the iterate, and choose how its penetrating stretches separate."""
        was_active = self.separation.is_active
        if point.infeasibility.amounts["poses"].max() < NEARLY_FEASIBLE:
            self.separation.update(point.z, point.at, point.between.crossings)
        if was_active or self.separation.is_active:
            point = self._make_point(point.z, point.at, point.between)
        self.point = point

    def _measure(self, z: Floats, contacts: Contacts) -> tuple[Infeasibility, float, float]:
        """Return infeasibility, objective and pose error, which depend on the timing."""
        infeasibility = measure_infeasibility(
            self.problem, z, self.timing, contacts, rates=self.rates
        )
        objective = self.problem.objective(z, self.timing.dt)
        pose_error = self.problem.row_error(z, self.timing.dt)
        return infeasibility, objective, pose_error

    def _judge(self, step: Step, trial: _Point) -> tuple[Floats, Floats, bool]:
        """Return predicted and actual penalty reduction per waypoint, and whether to accept.

        The penalty of waypoint t is Σ_j ν_j v_jt over the kinds j of constraints. From the iterate
        z to the trial z⁺, with the slacks s and relaxations e of the subproblem, the predicted and
        the actual reduction of the merit φ are

            f(z) − f(z⁺) + Σ_t (Σ_j ν_j v_jt(z) − ν_c s_t − e_t Σ_{j≠c} ν_j v_jt(z))
            f(z) − f(z⁺) + Σ_t Σ_j ν_j (v_jt(z) − v_jt(z⁺))

        The trial's penalty is infinite where a pair newly passes through each other, once the poses
        are nearly feasible. Before, and as long as stretches penetrate, the waypoints do not
        describe a motion yet.
        """
        point = self.point
        merit = self.merit
        penalty_of_slack = merit.weights["clearance"] * step.slack
        others = merit.compute_penalty(point.infeasibility, clearance=False)
        expected = penalty_of_slack + others * step.relaxation
        before = merit.compute_penalty(point.infeasibility, clearance=True)
        after = merit.compute_penalty(trial.infeasibility, clearance=True)
        are_poses_nearly_feasible = point.infeasibility.amounts["poses"].max() < NEARLY_FEASIBLE
        if are_poses_nearly_feasible and not self.separation.is_active:
            for crossing in find_new_crossings(trial.between.crossings, point.between.crossings):
                after[max(crossing.first - 1, 0) : crossing.last + 1] = np.inf
        penalty = float(before.sum())
        gain = point.objective - trial.objective
        accepted = is_step_acceptable(
            predicted=gain + penalty - float(expected.sum()),
            actual=gain + penalty - float(after.sum()),
            merit=point.objective + penalty,
        )
        return before - expected, before - after, accepted

    def _accept(self, trial: _Point) -> None:
        """Make `trial` the iterate; adapt time steps and rate limits to it."""
        was_infeasible = self.point.infeasibility.max_violation > TOLERANCE
        is_too_fast = self._is_too_fast(trial.z)
        self._set_point(trial)
        self.solution.z = trial.z
        point = self.point  # the trial, or the same waypoints with other directions of stretches
        last_timing = self.timing
        # Infeasible waypoints are a poor estimate of how long the motion takes.
        if was_infeasible and not self.rates:
            self.timing = self.problem.timing_for(point.z)
        # Before it is nearly clear, rate limits only cost time.
        if point.contacts.compute_violation() < NEARLY_FEASIBLE and is_too_fast:
            pace = self.problem.pace(point.z, self.timing.dt)
            self.timing = self.timing.stretch(*pace)
            if not self.rates and self._is_too_fast(point.z):
                self.rates = True
                self.subproblem.reset_multipliers()
        if self.timing is not last_timing:
            self.solution.dt = self.timing.dt
            point.infeasibility, point.objective, point.pose_error = self._measure(
                point.z, point.contacts
            )

    def _is_feasible(self) -> bool:
        """Return whether the iterate satisfies all constraints, also within segments."""
        return (
            self.point.is_clear
            and self.point.pose_error < TOLERANCE
            and not self._is_too_fast(self.point.z)
        )

    def _is_too_fast(self, z: Floats) -> bool:
        """Return whether waypoints z_1..z_N, shape (N, n), exceed rate limits at this timing."""
        pace = self.problem.pace(z, self.timing.dt)
        return self.timing.compute_violation(*pace) > TOLERANCE


def solve(
    problem: TrajectoryProblem,
    guess: Floats,
    *,
    callback: Callback | None = None,
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
    loop = _Loop(problem, guess, radius)
    solution = loop.solution
    try:
        rounds = problem.options.max_outer if rounds is None else rounds
        loop.run(callback or (lambda row: None), rounds)
    except BudgetExhaustedError as end:
        solution.status = "converged" if solution.converged else str(end)
    # Rounds after the first feasible one only try to shorten the trajectory.
    if loop.feasible is not None:
        solution.z, solution.dt = loop.feasible
    elif solution.status not in STOP_STATUSES:
        contacts = problem.evaluate_contacts(
            solution.z, reach=problem.options.largest_margin, nearest=1
        )
        shortfall = contacts.compute_violation()
        solution.shortfall = shortfall if shortfall > NEARLY_FEASIBLE else 0.0
    solution.radius = loop.region.radius
    return solution
