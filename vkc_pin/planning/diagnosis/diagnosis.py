"""Why a task cannot be done: what no motion could change, and what stands in the way of every goal configuration."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vkc_pin.planning.initialization.keyframes import depth, scatter
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.solver.trust_region import CLOSE_ENOUGH
from vkc_pin.utils.arrays import Floats
from vkc_pin.validation.report import Violation
from vkc_pin.world.scene.contact_rules import CONTACT_DEPTH

__all__ = ["Blocked", "blocked", "explain", "impossible"]

_DRAWS = 4  # batches of `SCATTER` random configurations before a goal counts as blocked
_DEEP = 0.05  # [m] or [rad]


class Blocked(NamedTuple):
    """A goal for which no free configuration was found.

    Attributes:
        text: One line for people.
        short: By how much the best one misses the goal [m] or [rad], or its margins [m].
    """

    text: str
    short: float

    @property
    def deep(self) -> bool:
        """Whether it is so far from good that no solver pushes it free."""
        return self.short > _DEEP


def impossible(problem: TrajectoryProblem) -> list[Violation]:
    """Return what is wrong before anything moves: a start in collision, a hand off what it holds, goals beyond limits."""
    found = []
    contacts, deepest = (
        problem.contacts.evaluate(problem.start[None], np.array([0]), reach=0.0),
        dict[str, float](),
    )
    for (first, second), distance, margin in zip(
        contacts.pair, contacts.distance, contacts.margin, strict=True
    ):
        if distance >= (
            margin if margin > CONTACT_DEPTH else margin - CONTACT_DEPTH
        ):  # as the scene allows, or in contact where that may be
            continue
        labels = problem.contacts.phases[0].labels
        subject = f"{labels[first]} – {labels[second]}"
        deepest[subject] = min(float(distance), deepest.get(subject, np.inf))
    for subject, distance in deepest.items():  # of links in pieces, each once
        detail = f"overlap by {-1e3 * distance:.1f} mm at the start"
        found.append(Violation("start", subject, amount=-distance, unit="m", detail=detail))
    for goal, solver in zip(problem.pose_goals, problem.transcription.pose_solvers, strict=True):
        if goal.kind == "closure" and goal.object in problem.scene.held and 1 in goal.row.waypoints:
            error = float(np.abs(solver.evaluate(problem.start[None], goal.target)[0]).max())
            if error > problem.options.closure_position:
                detail = f"it is held at the start, but the hand is {error:.4f} m or rad from its attachment"
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


def explain(problem: TrajectoryProblem, random_seed: int) -> list[Blocked]:
    """Return, for every goal that no free configuration was found for, the nearest miss or what collides with what.

    Args:
        problem: What could not be solved.
        random_seed: Of the random configurations tried.
    """
    found = (blocked(problem, number, random_seed) for number in range(len(problem.task.phases)))
    return [goal for goal in found if goal is not None]


def blocked(problem: TrajectoryProblem, number: int, random_seed: int) -> Blocked | None:
    """Return the same for the goal of one phase, by its number; None if a free configuration was found for it."""
    phase, end = problem.task.phases[number], int(problem.ends[number])
    tried = _try(problem, end, np.random.default_rng(random_seed))
    if tried is None:
        return None
    z, residual = tried
    if residual.min() > TOLERANCE:
        nearest = int(np.argmin(residual))
        text = (
            f"{phase.name}: out of reach, none of {len(z)} configurations tried gets there; "
            f"the nearest stays {residual[nearest]:.3f} m or rad short"
        )
        return Blocked(text, float(residual[nearest]))
    reached = z[residual < TOLERANCE]
    contacts = problem.contacts.evaluate(
        reached, np.full(len(reached), end), reach=problem.options.largest_margin
    )
    shortfall = contacts.compute_shortfall(len(reached))
    if shortfall.min() <= CLOSE_ENOUGH:  # a motion that ended so may go on so
        return None
    best = int(np.argmin(shortfall))
    worst = int(np.flatnonzero(contacts.waypoint == best)[0])
    labels = problem.contacts.phases[problem.contacts.find_phase(end)].labels
    first, second = contacts.pair[worst]
    text = (
        f"{phase.name}: all {len(reached)} configurations found there are blocked; in the least blocked one "
        f"{labels[first]} – {labels[second]} {_gap(contacts.distance[worst])}"
    )
    return Blocked(text, float(shortfall[best]))


def _try(
    problem: TrajectoryProblem, waypoint: int, rng: np.random.Generator
) -> tuple[Floats, Floats] | None:
    """Return what `scatter` does, drawn again and again until something is free, up to `_DRAWS` times."""
    found: list[tuple[Floats, Floats]] = []
    for _ in range(_DRAWS):
        tried = scatter(problem, waypoint, rng)
        if tried is None:
            return None
        found.append(tried)
        z = tried[0][tried[1] < TOLERANCE]
        if len(z) and depth(problem, z, waypoint).min() <= CLOSE_ENOUGH:
            break
    return np.concatenate([z for z, _ in found]), np.concatenate(
        [residual for _, residual in found]
    )


def _gap(distance: float) -> str:
    return (
        f"overlap by {-1e3 * distance:.1f} mm"
        if distance < 0
        else f"are only {1e3 * distance:.1f} mm apart"
    )
