"""The sequential witness-plane loop: subproblems in a trust region, judged by an exact ℓ1 merit function."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from vkc_pin.planning.chain.contacts import Contacts
from vkc_pin.planning.nlp.merit import TOLERANCE, Infeasibility, Merit, measure_infeasibility
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.solver.segment_planes import collisions_between, merge
from vkc_pin.planning.solver.solution import Iteration, Solution
from vkc_pin.planning.solver.subproblem import Subproblem
from vkc_pin.planning.solver.trust_region import (
    BLOCK_TIME,
    CLOSE_ENOUGH,
    INSIDE,
    Trial,
    TrustRegion,
    judge,
)
from vkc_pin.planning.solver.tunnelling import Passage, new
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.budget import ENDINGS, SpentError, spend

__all__ = ["solve"]

# [m], [rad] of clearance, or of closures, goals and grasps, that is missing of a motion that nearly
# holds
NEARLY = 0.01
# rounds in which what is missing must fall; accepted ones, where hardly any clearance is missing
PROGRESS_ROUNDS = 5
PROGRESS = 0.7  # share of what was missing to which it must fall, or the motion is given up
WORTHWHILE = (
    0.05  # relative decrease of the objective for which a feasible motion is improved further
)


class _Loop:
    """The state between rounds: the current waypoints, their contacts, what does not hold there, and weights."""

    def __init__(self, problem: TrajectoryProblem, seed: Floats, weight: float) -> None:
        self.problem, self.options = problem, problem.options
        self.z = problem.clip(seed)
        self.timing = problem.timing_for(self.z)
        self.rates = False
        self.merit = Merit(weight)
        self.solution = Solution(self.z, self.timing.dt)
        self.subproblem = Subproblem(problem, self.solution)
        self.feasible: tuple[Floats, Floats] | None = (
            None  # the last motion at which everything held
        )

    def begin(self) -> None:
        """Find what is close and what does not hold at the seed."""
        self.at, _, self.passages = self.contacts(self.z)
        self.look()

    def look(self) -> None:
        """Find anew what does not hold at the current waypoints, and what they cost."""
        self.found = self.missing(self.z, self.at)
        self.objective = self.problem.objective(self.z, self.timing.dt)
        self.pose_error = self.problem.row_error(self.z, self.timing.dt)

    def missing(self, z: Floats, at: Contacts) -> Infeasibility:
        """Return what does not hold at waypoints."""
        return measure_infeasibility(self.problem, z, self.timing, at, rates=self.rates)

    def contacts(self, z: Floats) -> tuple[Contacts, bool, list[Passage]]:
        """Return what is close at the waypoints and between them, whether all is far enough, and what goes through each other."""
        begin = time.perf_counter()
        found = self.problem.evaluate_contacts(
            z, reach=self.options.contact_reach, nearest=self.options.contact_slots
        )
        between = collisions_between(self.problem, z)
        self.solution.timings["coal"] += time.perf_counter() - begin
        clear = between.free and found.compute_violation() < CLOSE_ENOUGH
        return merge(found, between.contacts), clear, between.passages

    def try_step(self, radius: Floats) -> Trial:
        """Solve within `radius` of the current waypoints, and look at what is really there."""
        z, slack, shares, satisfied = self.subproblem.solve(
            self.z, self.at, self.found, self.merit, self.timing, radius, rates=self.rates
        )
        contacts, clear, passed = self.contacts(z)
        promise = (
            self.merit.weights["clearance"] * slack
            + self.merit.compute_penalty(self.found, clearance=False) * shares
        )
        return Trial(
            z=z,
            promise=promise,
            objective=self.problem.objective(z, self.timing.dt),
            pose_error=self.problem.row_error(z, self.timing.dt),
            found=self.missing(z, contacts),
            contacts=contacts,
            clear=clear,
            passages=passed,
            rate=self.timing.compute_violation(*self.problem.pace(z)),
            step=np.abs(z - self.z).max(axis=1),
            satisfied=satisfied,
        )

    def prices(self, trial: Trial) -> tuple[Floats, Floats]:
        """Return what all that is missing costs at every waypoint, before a round and where it led, shape (N,) each.

        It is infinite where a pair goes through each other that did not before. Of what is no
        motion yet that says nothing.
        """
        before, after = (
            self.merit.compute_penalty(found, clearance=True) for found in (self.found, trial.found)
        )
        if self.found.amounts["poses"].max() < NEARLY:
            for passage in new(trial.passages, self.passages):
                after[max(passage.first - 1, 0) : passage.last + 1] = np.inf
        return before, after

    def judge(self, trial: Trial, before: Floats, after: Floats) -> bool:
        """Return whether enough of the promised decrease came true to accept a step; `before` and `after`: see `prices`."""
        missing, gain = float(before.sum()), self.objective - trial.objective
        return judge(
            gain + missing - float(trial.promise.sum()),
            gain + missing - float(after.sum()),
            self.objective + missing,
        )

    def accept(self, trial: Trial) -> None:
        """Go on from `trial`."""
        far = self.found.max_violation > TOLERANCE
        self.z, self.at, self.found, self.passages = (
            trial.z,
            trial.contacts,
            trial.found,
            trial.passages,
        )
        self.objective, self.pose_error = trial.objective, trial.pose_error
        self.solution.z = trial.z
        if far and not self.rates:  # what was no motion yet says little about how long one takes
            self.timing = self.problem.timing_for(self.z)
            self.solution.dt = self.timing.dt
            self.look()
        nearly = trial.contacts.compute_violation() < NEARLY
        if nearly and trial.rate > TOLERANCE:  # before, limits on rates only cost time
            pace = self.problem.pace(trial.z)
            self.timing = self.timing.stretch(*pace)
            self.solution.dt = self.timing.dt
            if not self.rates and self.timing.compute_violation(*pace) > TOLERANCE:
                self.rates = True
                self.subproblem.forget()
            self.look()

    def done(self, trial: Trial) -> bool:
        """Return whether everything holds at the waypoints of a step just accepted, and nothing collides between them."""
        return (
            trial.satisfied
            and trial.clear
            and self.pose_error < TOLERANCE
            and self.timing.compute_violation(*self.problem.pace(trial.z)) <= TOLERANCE
        )

    def grow(self) -> bool:
        """Make dearer what is missing; return whether anything could be."""
        self.subproblem.forget()
        return self.merit.increase_weights(self.found, CLOSE_ENOUGH)


def solve(
    problem: TrajectoryProblem,
    seed: Floats,
    *,
    callback: Callable[[Iteration], None] | None = None,
    rounds: int | None = None,
    radius: Floats | None = None,
) -> Solution:
    """Return the trajectory that the witness-plane loop reaches from `seed`, or the best iterate when the budget is at its end.

    Args:
        problem: What to solve.
        seed: z_1..z_N, shape (N, n).
        callback: Called after every round.
        rounds: At most so many rounds; None: `Options.max_outer`.
        radius: How far planes are believed at first, shape (N,): `Solution.radius` where another
            solution goes on.
    """
    loop = _Loop(problem, seed, problem.options.penalty)
    solution = loop.solution
    region = TrustRegion(problem.segments, problem.options.steps(BLOCK_TIME), radius)
    try:
        loop.begin()
        _iterate(loop, region, callback, loop.options.max_outer if rounds is None else rounds)
    except SpentError as end:
        solution.status = "converged" if solution.converged else str(end)
    if (
        loop.feasible is not None
    ):  # rounds after the first feasible one only made it shorter, or failed to
        solution.z, solution.dt = loop.feasible
    elif solution.status not in ENDINGS:
        short = problem.evaluate_contacts(
            solution.z, reach=problem.options.largest_margin, nearest=1
        ).compute_violation()
        solution.astray = short if short > NEARLY else 0.0
    solution.radius = region.radius
    return solution


def _iterate(
    loop: _Loop, region: TrustRegion, callback: Callable[[Iteration], None] | None, rounds: int
) -> None:
    """Run rounds until everything holds or nothing helps any more."""
    solution, started = loop.solution, time.perf_counter()
    missing, since = loop.found.total, 0  # what was missing when rounds were last counted
    short, nearly = loop.found.amounts["clearance"], _nearly(loop.found)
    good = float("inf")  # objective of the last motion at which everything held
    for _ in range(rounds):
        spend()
        trial = loop.try_step(region.radius)
        before, after = loop.prices(trial)
        accepted = loop.judge(trial, before, after)
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
            last = loop.objective if nearly else good
            loop.accept(trial)
            if done := loop.done(trial):
                good = trial.objective
                if (
                    loop.problem.drift(trial.z) <= 1.0
                ):  # that waypoints are too far apart along an arc no round can help
                    solution.converged, solution.status, loop.feasible = (
                        True,
                        "converged",
                        (trial.z, solution.dt),
                    )
                improved = good < (1.0 - WORTHWHILE) * last
                if not improved or (trial.step < INSIDE * used).all():
                    break
        region.adapt(before, after, trial, accepted)
        since += (
            accepted or short.max() >= NEARLY
        )  # refused steps narrow the region, which has an end
        if (
            not PROGRESS * missing < loop.found.total <= missing
        ):  # more is missing where the objective fell instead
            missing, since = loop.found.total, 0
        if since >= PROGRESS_ROUNDS:
            break
        short, nearly = loop.found.amounts["clearance"], _nearly(loop.found)
        if accepted and not done and nearly:
            region.settle()
        if region.stuck(trial, short):
            if short.max() >= NEARLY or not loop.grow():
                break
            region.restart()


def _nearly(found: Infeasibility) -> bool:
    """Return whether everything holds but for a little clearance."""
    return bool(found.amounts["clearance"].max() < NEARLY) and found.max_violation < TOLERANCE
