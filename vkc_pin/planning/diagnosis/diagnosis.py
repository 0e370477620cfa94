"""Explains why a task fails: impossible conditions, and collisions of all goal configurations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vkc_pin.planning.initialization.keyframes import compute_shortfall, sample_goal_configurations
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.solver.trust_region import CLEARANCE_TOLERANCE
from vkc_pin.utils.arrays import Floats
from vkc_pin.validation.report import Violation
from vkc_pin.validation.tolerances import Tolerances
from vkc_pin.world.scene.contact_rules import CONTACT_DEPTH

__all__ = ["BlockedGoal", "diagnose_goal", "diagnose_goals", "find_impossible_conditions"]

_MAX_BATCHES = 4  # batches of `SAMPLE_COUNT` random configurations before a goal counts as blocked
_DEEP_SHORTFALL = 0.05  # [m], [rad] above which the solver cannot repair a goal configuration


class BlockedGoal(NamedTuple):
    """A goal without a known collision-free configuration.

    Attributes:
        text: Explanation, one line.
        shortfall: Residual [m] or [rad], or clearance shortfall [m], of the best configuration.
    """

    text: str
    shortfall: float

    @property
    def is_deep(self) -> bool:
        """Whether the shortfall is too large for the solver to repair."""
        return self.shortfall > _DEEP_SHORTFALL


def find_impossible_conditions(problem: TrajectoryProblem) -> list[Violation]:
    """Find violations that no motion can change, at the start or of goals beyond limits."""
    found = []
    contacts, deepest = (
        problem.contacts.evaluate(problem.start[None], np.array([0]), reach=0.0),
        dict[str, float](),
    )
    for (first, second), distance, margin in zip(
        contacts.pair, contacts.distance, contacts.margin, strict=True
    ):
        # Margins may be negative where the scene allows contact.
        if distance >= (margin if margin > CONTACT_DEPTH else margin - CONTACT_DEPTH):
            continue
        labels = problem.contacts.phases[0].labels
        subject = f"{labels[first]} – {labels[second]}"
        deepest[subject] = min(float(distance), deepest.get(subject, np.inf))
    for subject, distance in deepest.items():  # links of several shapes count once
        detail = f"overlap by {-1e3 * distance:.1f} mm at the start"
        found.append(Violation("start", subject, amount=-distance, unit="m", detail=detail))
    for goal, solver in zip(problem.pose_goals, problem.transcription.pose_solvers, strict=True):
        if goal.kind == "closure" and goal.object in problem.scene.held and 1 in goal.row.waypoints:
            error = float(np.abs(solver.evaluate(problem.start[None], goal.target)[0]).max())
            if error > Tolerances().closure_position:
                detail = (
                    f"it is grasped at the start, but the hand is {error:.4f} m or rad "
                    "from its attachment"
                )
                found.append(
                    Violation("closure", goal.about, amount=error, unit="m", detail=detail)
                )
    dt = problem.timing_for(problem.still).dt
    for phase, end in zip(problem.task.phases, problem.ends, strict=True):
        waypoint, time = int(end), float(dt[:end].sum())
        goals = dict(phase.values)
        if phase.base is not None:
            goals |= {
                n: v
                for n, v in zip(problem.chain.names[:2], phase.base[:2], strict=True)
                if v is not None
            }
        for name, value in goals.items():
            lower, upper = problem.limits(name)
            beyond = max(lower - value, value - upper)
            if beyond > 1e-9:
                detail = f"{value:g} is beyond the limits {lower:g} to {upper:g} by {beyond:.4g}"
                found.append(
                    Violation(
                        "goal",
                        name,
                        waypoint=waypoint,
                        time=time,
                        amount=beyond,
                        unit=problem.unit(name),
                        detail=detail,
                    )
                )
    return found


def diagnose_goals(problem: TrajectoryProblem, random_seed: int) -> list[BlockedGoal]:
    """Explain all goals without a known collision-free configuration.

    Args:
        problem: Problem that could not be solved.
        random_seed: Random seed.
    """
    found = (
        diagnose_goal(problem, number, random_seed) for number in range(len(problem.task.phases))
    )
    return [goal for goal in found if goal is not None]


def diagnose_goal(problem: TrajectoryProblem, number: int, random_seed: int) -> BlockedGoal | None:
    """Explain the goal of one phase; None if it has a collision-free configuration."""
    phase, end = problem.task.phases[number], int(problem.ends[number])
    tried = _sample_goal(problem, end, np.random.default_rng(random_seed))
    if tried is None:
        return None
    z, residual = tried
    if residual.min() > TOLERANCE:
        nearest = int(np.argmin(residual))
        text = (
            f"{phase.name}: out of reach, none of {len(z)} configurations tried gets there; "
            f"the nearest stays {residual[nearest]:.3f} m or rad short"
        )
        return BlockedGoal(text, float(residual[nearest]))
    reached = z[residual < TOLERANCE]
    contacts = problem.contacts.evaluate(
        reached, np.full(len(reached), end), reach=problem.options.largest_margin
    )
    shortfall = contacts.compute_shortfall(len(reached))
    if shortfall.min() <= CLEARANCE_TOLERANCE:
        return None
    best = int(np.argmin(shortfall))
    worst = int(np.flatnonzero(contacts.waypoint == best)[0])
    labels = problem.contacts.phases[problem.contacts.find_phase(end)].labels
    first, second = contacts.pair[worst]
    text = (
        f"{phase.name}: all {len(reached)} configurations found there are blocked; "
        "in the least blocked one "
        f"{labels[first]} – {labels[second]} {_describe_gap(contacts.distance[worst])}"
    )
    return BlockedGoal(text, float(shortfall[best]))


def _sample_goal(
    problem: TrajectoryProblem, waypoint: int, rng: np.random.Generator
) -> tuple[Floats, Floats] | None:
    """Sample goal configurations in up to `_MAX_BATCHES` batches, until one is collision-free."""
    found: list[tuple[Floats, Floats]] = []
    for _ in range(_MAX_BATCHES):
        tried = sample_goal_configurations(problem, waypoint, rng)
        if tried is None:
            return None
        found.append(tried)
        z = tried[0][tried[1] < TOLERANCE]
        if len(z) and compute_shortfall(problem, z, waypoint).min() <= CLEARANCE_TOLERANCE:
            break
    return np.concatenate([z for z, _ in found]), np.concatenate(
        [residual for _, residual in found]
    )


def _describe_gap(distance: float) -> str:
    return (
        f"overlap by {-1e3 * distance:.1f} mm"
        if distance < 0
        else f"are only {1e3 * distance:.1f} mm apart"
    )
