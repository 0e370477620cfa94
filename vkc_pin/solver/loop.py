"""Ipopt inside the sequential witness-plane loop: an exact ℓ1 penalty on clearance, a trust region, warm starts."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from vkc_pin.arrays import Floats
from vkc_pin.chain.contacts import Contacts
from vkc_pin.interrupt import Interrupt, interruptible
from vkc_pin.program.problem import TrajectoryProblem
from vkc_pin.solver.between import collisions_between, merge
from vkc_pin.solver.solution import Iteration, Resume, Solution
from vkc_pin.solver.trust_region import BLOCK_TIME, CLOSE_ENOUGH, FAR, Trial, TrustRegion, judge

__all__ = ["solve"]

_IPOPT: Mapping[str, Any] = {
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.linear_solver": "mumps",
    "ipopt.tol": 1e-4,
    "ipopt.acceptable_tol": 1e-3,
    "ipopt.constr_viol_tol": 1e-5,
    "ipopt.mu_init": 1e-2,
    "ipopt.nlp_scaling_method": "none",
}
_WARM: Mapping[str, Any] = {
    "ipopt.warm_start_init_point": "yes",
    "ipopt.warm_start_bound_push": 1e-6,
    "ipopt.warm_start_bound_frac": 1e-6,
    "ipopt.warm_start_slack_bound_push": 1e-6,
    "ipopt.warm_start_slack_bound_frac": 1e-6,
    "ipopt.warm_start_mult_bound_push": 1e-6,
    "ipopt.mu_init": 1e-3,
}
EARLY = 0.05  # [m] shortfall of clearance below which collisions between waypoints count
NEARLY_FREE = 0.01  # [m] shortfall of clearance below which a motion is nearly free: before, limits on rates only cost time
POSE_TOLERANCE = 1e-4  # [m] and [rad] largest residual of a solution
SOLVED_RATE_TOLERANCE = 1e-4  # excess over a limit on velocity or acceleration, relative; the check allows more
DRIFT = 0.9  # share of what a grasp may drift between waypoints that a solution may use
SETTLING = 0.2  # relative decrease of the objective below which a motion that is nearly free is first made free
GIVE_UP_ROUNDS = 6  # rounds after which motions that are far from free are given up:
GIVE_UP_SHORTFALL = 0.1  # [m] shortfall of clearance of their worst waypoint
GIVE_UP_DRIFT = 2.0  # or their drift, as a share of what it may be: waypoints are too far apart for them
INSIDE = 0.9  # share of the trust region: steps that end there were not held back (Ipopt ends a little inside its bounds)
WORTHWHILE = 0.05  # relative decrease of the objective for which a feasible motion is improved further
PENALTY_GROWTH = 4.0  # ratio of the penalty on clearance to the one before
PENALTY_LIMIT = 2000.0  # [1/m] largest penalty


class _Loop:
    """The state between rounds: the current waypoints, their contacts, multipliers and penalty."""

    def __init__(self, problem: TrajectoryProblem, seed: Floats, deadline: float = np.inf) -> None:
        self.deadline = deadline
        self.problem, self.options = problem, problem.options
        self.transcription = problem.transcription
        self.z = problem.clip(seed)
        self.timing = problem.timing_for(self.z)
        self.multipliers: dict[str, Any] = {}
        self.rates = False
        self.penalty = problem.options.penalty
        self.solution = Solution(self.z, self.timing.dt)
        self.targets = problem.target_matrix()
        self.between = False
        self.at, _ = self.contacts(self.z)
        self.shortfall = self.at.shortfall(problem.segments)
        self.objective = problem.objective(self.z, self.timing.dt)
        self.pose_error = problem.row_error(self.z, self.timing.dt)

    def contacts(self, z: Floats) -> tuple[Contacts, bool]:
        """Return what is close at the waypoints and, once that was needed, between them, and whether that is far enough."""
        begin = time.perf_counter()
        found = self.problem.evaluate_contacts(z, reach=self.options.contact_reach, nearest=self.options.contact_slots)
        clear = found.violation() < CLOSE_ENOUGH
        if self.between:
            collisions, free = collisions_between(self.problem, z)
            found, clear = merge(found, collisions), clear and free
        self.solution.timings["coal"] += time.perf_counter() - begin
        return found, clear

    def free_between(self, trial: Trial) -> bool:
        """Return whether nothing collides between waypoints; if something does, look there from now on."""
        if trial.between:
            return trial.clear
        begin = time.perf_counter()
        found, free = collisions_between(self.problem, trial.z)
        self.solution.timings["coal"] += time.perf_counter() - begin
        if not free and not self.between:
            self.between = True
            self.at = merge(self.at, found)
            self.shortfall = self.at.shortfall(self.problem.segments)
        return free

    def try_step(self, radius: Floats) -> Trial:
        """Solve within `radius` of the current waypoints, and look at what is really there."""
        z, slack, objective, satisfied = self.run_ipopt(radius)
        contacts, clear = self.contacts(z)
        return Trial(
            z=z,
            slack=slack,
            objective=objective - self.penalty * float(slack.sum()),
            pose_error=self.problem.row_error(z, self.timing.dt),
            contacts=contacts,
            shortfall=contacts.shortfall(self.problem.segments),
            clear=clear,
            between=self.between,
            rate=self.timing.violation(*self.problem.rates(z)),
            step=np.abs(z - self.z).max(axis=1),
            satisfied=satisfied,
        )

    def judge(self, trial: Trial) -> tuple[bool, float]:
        """Return whether to accept a step, and how much of the promised decrease of the ℓ1 merit came true."""
        return judge(trial, self.objective, self.shortfall, penalty=self.penalty, pose_error=self.pose_error)

    def accept(self, trial: Trial) -> None:
        """Go on from `trial`."""
        self.z, self.at, self.shortfall = trial.z, trial.contacts, trial.shortfall
        self.objective, self.pose_error = trial.objective, trial.pose_error
        self.solution.z = trial.z
        if not self.between and 0.0 < trial.contacts.violation() < EARLY:
            self.free_between(trial)
        if trial.rate > SOLVED_RATE_TOLERANCE and trial.contacts.violation() < NEARLY_FREE:  # before, it only costs time
            rates = self.problem.rates(trial.z)
            self.timing = self.timing.stretched(*rates)
            self.solution.dt = self.timing.dt
            if self.transcription.structure.timed:
                self.objective = self.problem.objective(trial.z, self.timing.dt)
                self.pose_error = self.problem.row_error(trial.z, self.timing.dt)
            if not self.rates and self.timing.violation(*rates) > SOLVED_RATE_TOLERANCE:
                self.rates, self.multipliers = True, {}

    def done(self, trial: Trial) -> bool:
        """Return whether everything holds at the waypoints of a step just accepted, and nothing collides between them."""
        return (
            trial.satisfied
            and trial.clear
            and self.pose_error < POSE_TOLERANCE
            and self.timing.violation(*self.problem.rates(trial.z)) <= SOLVED_RATE_TOLERANCE
            and self.free_between(trial)
        )

    def astray(self) -> bool:
        """Return whether the user's own constraints are still far from holding; small steps would take long to get there."""
        return self.problem.term_numbers.error(self.z, self.timing.dt) > FAR

    def raise_penalty(self) -> None:
        """Make clearance dearer."""
        self.penalty = min(self.penalty * PENALTY_GROWTH, PENALTY_LIMIT)
        self.multipliers = {}

    def run_ipopt(self, radius: Floats) -> tuple[Floats, Floats, float, bool]:
        """Solve once with fixed planes; return waypoints, slack, objective and whether Ipopt was satisfied."""
        problem, t = self.problem, self.transcription
        begin = time.perf_counter()
        planes, offsets = problem.contacts.planes(self.z, self.at, slots=t.slots)
        self.solution.timings["coal"] += time.perf_counter() - begin
        lower, upper = np.maximum(problem.lower, self.z - radius[:, None]), np.minimum(problem.upper, self.z + radius[:, None])
        bounds = problem.row_bounds(self.timing if self.rates else None)
        options = {**_IPOPT, **(_WARM if self.multipliers else {}), "ipopt.max_iter": self.options.max_iterations}
        solver = t.solver(rates=self.rates, options=options, deadline=self.deadline)
        arguments = {
            "x0": np.column_stack([self.z, self.shortfall]).ravel(),
            "lbx": np.column_stack([lower, np.zeros(t.segments)]).ravel(),
            "ubx": np.column_stack([upper, np.full(t.segments, np.inf)]).ravel(),
            "lbg": bounds[0],
            "ubg": bounds[1],
            "p": t.parameter_vector(problem.start, planes, offsets, self.targets, penalty=self.penalty, dt=self.timing.dt),
        }
        begin = time.perf_counter()
        result = solver(**arguments, **self.multipliers)
        total = time.perf_counter() - begin
        stats = solver.stats()
        casadi_time = sum(value for key, value in stats.items() if key.startswith("t_wall_nlp_"))
        self.solution.timings["casadi"] += casadi_time
        self.solution.timings["ipopt"] += total - casadi_time
        self.solution.iterations += int(stats["iter_count"])
        self.multipliers = {"lam_x0": result["lam_x"], "lam_g0": result["lam_g"]}
        x = np.asarray(result["x"]).reshape(t.segments, t.n + 1)
        slack = np.maximum(x[:, -1], 0.0)
        return x[:, :-1], slack, float(result["f"]), bool(stats["success"])


def solve(
    problem: TrajectoryProblem,
    seed: Floats,
    *,
    callback: Callable[[Iteration], None] | None = None,
    deadline: float = np.inf,
    rounds: int | None = None,
    radius: Floats | None = None,
    penalty: float | None = None,
    patient: bool = True,
    thorough: bool = True,
    interrupt: Interrupt | None = None,
) -> Solution:
    """Return the trajectory that the witness-plane loop reaches from `seed`.

    Args:
        problem: What to solve.
        seed: z_1..z_N, shape (N, n).
        callback: Called after every round.
        deadline: Value of `time.perf_counter()` at which to stop with the best iterate.
        rounds: At most so many rounds; None: `Options.max_outer`.
        radius: How far planes are believed at first, shape (N,): `Solution.radius` where another solution goes on.
        penalty: What clearance costs at first; None: `Options.penalty`.
        patient: Whether to make clearance dearer and go on where nothing moves any more. That takes many rounds and seldom helps:
            where there are other seeds, they come first. `Solution.resume` is what to go on with.
        thorough: Whether to go on from a motion at which everything holds as long as it gets shorter.
        interrupt: Ends it after the round that is running; None: Ctrl-C does.
    """
    loop = _Loop(problem, seed, deadline)
    loop.penalty = loop.penalty if penalty is None else penalty
    solution = loop.solution
    with interruptible() if interrupt is None else contextlib.nullcontext(interrupt) as noted:
        region = TrustRegion(problem.segments, problem.options.steps(BLOCK_TIME), radius)
        _iterate(loop, region, callback, noted, loop.options.max_outer if rounds is None else rounds, patient, thorough)
    solution.radius = region.radius
    if noted.pressed:  # whichever way the loop ended, nothing else is to be tried
        solution.status = "interrupted"
    return solution


def _iterate(
    loop: _Loop,
    region: TrustRegion,
    callback: Callable[[Iteration], None] | None,
    interrupt: Interrupt,
    rounds: int,
    patient: bool,
    thorough: bool,
) -> None:
    """Run rounds until everything holds, nothing helps any more, or time is up."""
    solution, started = loop.solution, time.perf_counter()
    feasible: tuple[Floats, Floats] | None = None
    good = float("inf")  # objective of the last motion at which everything held
    for _ in range(rounds):
        if time.perf_counter() > loop.deadline:
            solution.status = solution.status if solution.converged else "time limit"
            break
        trial = loop.try_step(region.radius)
        accepted, ratio = loop.judge(trial)
        solution.rounds += 1
        row = Iteration(
            round=solution.rounds,
            iterations=solution.iterations,
            objective=trial.objective,
            clearance=trial.contacts.clearance(),
            shortfall=trial.contacts.violation(),
            pose_error=trial.pose_error,
            step=float(trial.step.max()),
            radius=float(region.radius.max()),
            penalty=loop.penalty,
            accepted=accepted,
            time=time.perf_counter() - started,
        )
        solution.history.append(row)
        if callback is not None:
            callback(row)
        before, used = loop.shortfall, region.radius
        if accepted:
            gain = (loop.objective - trial.objective) / max(abs(loop.objective), 1e-9)
            loop.accept(trial)
            if done := loop.done(trial):
                last, good = good, trial.objective
                if loop.problem.drift(trial.z) < DRIFT:  # that waypoints are too far apart along an arc no round can help
                    solution.converged, solution.status, feasible = True, "converged", (trial.z, solution.dt)
                improved = good < (1.0 - WORTHWHILE) * last
                if not thorough or not improved or (trial.step < INSIDE * used).all():
                    break
        if interrupt.pressed:
            solution.status = solution.status if solution.converged else "interrupted"
            break
        region.adapt(before, trial, accepted, ratio)
        settled = accepted and not done and gain < SETTLING and not loop.astray()
        if settled and loop.shortfall.max() < NEARLY_FREE:
            region.settle()
        if solution.rounds >= GIVE_UP_ROUNDS and (
            loop.shortfall.max() > GIVE_UP_SHORTFALL or loop.problem.drift(loop.z) > GIVE_UP_DRIFT
        ):
            break
        if region.stuck(trial, loop.shortfall):
            if loop.penalty >= PENALTY_LIMIT:
                break
            loop.raise_penalty()
            region.restart()
            if not patient and not solution.converged:
                solution.resume = Resume(region.radius, loop.penalty)
                break
    if feasible is not None:  # rounds after the first feasible one only made it shorter, or failed to
        solution.z, solution.dt = feasible
