"""Explains why a task fails: impossible conditions, and collisions of all goal configurations."""

from __future__ import annotations

import contextlib
from typing import NamedTuple

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.planning.initialization.keyframes import (
    find_free_configurations,
    sample_goal_configurations,
)
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Floats
from vkc_pin.validation.report import Violation
from vkc_pin.validation.tolerances import Tolerances
from vkc_pin.world.models.shapes import LIMIT_SLACK
from vkc_pin.world.scene.clearance_exemptions import ACCEPTED_SHORTFALL, CONTACT_DEPTH
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.task.steps import Actuate

_MAX_BATCHES = 4  # batches of `SAMPLE_COUNT` random configurations before a goal counts as blocked
_DEEP_SHORTFALL = 0.05  # [m], [rad] above which the solver cannot repair a goal configuration
_BASE = 1  # the joint of the model that is the base
_BISECTIONS = 5  # of the motion of an object joint, with one batch each: 1 s or less


class BlockedGoal(NamedTuple):
    """A goal without a known collision-free configuration.

    Attributes:
        text: Explanation, one line.
        shortfall: Residual [m] or [rad], or clearance shortfall [m], of the best configuration.
        phase: Number of the phase, from 0.
    """

    text: str
    shortfall: float
    phase: int

    @property
    def is_deep(self) -> bool:
        """Whether the shortfall is too large for the solver to repair."""
        return self.shortfall > _DEEP_SHORTFALL


def find_impossible_conditions(problem: TrajectoryProblem) -> list[Violation]:
    """Find violations that no motion can change, at the start or of goals beyond limits.

    They name waypoints, but no times, which depend on the motion in the plan.
    """
    start = problem.start[None]
    contacts = problem.contacts.evaluate(start, np.array([0]), reach=0.0)
    labels, deepest = problem.contacts.phases[0].labels, dict[str, float]()
    for (first, second), distance, margin in zip(
        contacts.pair, contacts.distance, contacts.margin, strict=True
    ):
        # Margins may be negative where the scene allows contact.
        if distance < (margin if margin > CONTACT_DEPTH else margin - CONTACT_DEPTH):
            subject = f"{labels[first]} – {labels[second]}"
            deepest[subject] = min(float(distance), deepest.get(subject, np.inf))
    found = []
    for subject, distance in deepest.items():  # links of several shapes count once
        depth = f"{-1e3 * distance:.1f}"
        detail = "touch at the start" if depth == "0.0" else f"overlap by {depth} mm at the start"
        found.append(Violation("start", subject, amount=-distance, unit="m", detail=detail))
    for goal, solver in zip(problem.pose_goals, problem.transcription.pose_solvers, strict=True):
        if goal.kind == "closure" and goal.object in problem.scene.held and 1 in goal.row.waypoints:
            error = float(np.abs(solver.evaluate(start, goal.target)[0]).max())
            if error > Tolerances().closure_position:
                detail = (
                    f"it is grasped at the start, but the hand is {error:.4f} m or rad "
                    "from its attachment"
                )
                with contextlib.suppress(InputError):
                    problem.scene.with_measured_grasp(goal.object)
                    detail += "; if it is there, see Scene.with_measured_grasp"
                found.append(
                    Violation("closure", goal.about, amount=error, unit="m", detail=detail)
                )
    for phase, end in zip(problem.task.phases, problem.ends.tolist(), strict=True):
        for name, (least, most) in problem.coordinate_goals(phase).items():
            lower, upper = problem.limits(name)
            beyond = max(lower - most, least - upper)
            if beyond > LIMIT_SLACK:
                unit = problem.unit(name)
                value = most if most < lower else least
                detail = (
                    f"{value:g} {unit} is beyond the limits {lower:g} to {upper:g} {unit} "
                    f"by {beyond:.4g} {unit}"
                )
                found.append(
                    Violation("goal", name, waypoint=end, amount=beyond, unit=unit, detail=detail)
                )
        if phase.kind == "configure":
            found += _find_collisions_at_goal(problem, end)
    return found


def _find_collisions_at_goal(problem: TrajectoryProblem, end: int) -> list[Violation]:
    """Find the pairs that are too close at a waypoint whatever the coordinates left free are."""
    lower, upper = problem.lower[end - 1], problem.upper[end - 1]
    z = np.clip(problem.start, lower, upper)
    reach = problem.options.largest_margin
    contacts = problem.contacts.evaluate(z[None], np.array([end]), reach=reach)
    labels = problem.contacts.phases[problem.contacts.find_phase(end)].labels
    joints = problem.contacts.get_joints(contacts.pair).tolist()
    moving = set(np.flatnonzero(problem.chain.coordinates.find_moved_joints(lower < upper)))
    supports = [set(joint_path) for joint_path in problem.chain.model.supports]
    found = dict[str, Violation]()
    for (first, second), ends, distance, margin in zip(
        contacts.pair, joints, contacts.distance.tolist(), contacts.margin.tolist(), strict=True
    ):
        between = supports[ends[0]] ^ supports[ends[1]]
        if FLOOR in (labels[first], labels[second]):
            between.discard(_BASE)  # driving leaves the distance from the floor as it is
        if margin - distance <= ACCEPTED_SHORTFALL or between & moving:
            continue
        subject = f"{labels[first]} – {labels[second]}"
        detail = f"overlap by {-1e3 * distance:.1f} mm at the goal"
        if distance > 0.0:
            detail = f"are only {1e3 * distance:.1f} of {1e3 * margin:g} mm apart at the goal"
        amount = margin - distance
        worst = Violation("goal", subject, waypoint=end, amount=amount, unit="m", detail=detail)
        # Contacts are sorted: the deepest of links with several shapes comes first.
        found.setdefault(subject, worst)
    return list(found.values())


def diagnose_goals(problem: TrajectoryProblem, random_seed: int) -> list[BlockedGoal]:
    """Explain all goals of an unsolved problem without a known collision-free configuration."""
    numbers = range(len(problem.task.phases))
    found = (diagnose_goal(problem, number, random_seed) for number in numbers)
    return [goal for goal in found if goal is not None]


def diagnose_goal(problem: TrajectoryProblem, number: int, random_seed: int) -> BlockedGoal | None:
    """Explain the goal of one phase; None if it has a collision-free configuration."""
    phase, end = problem.task.phases[number], int(problem.ends[number])
    samples = _sample_goal(problem, end, np.random.default_rng(random_seed))
    if samples is None:
        return None
    z, residual = samples
    if residual.min() > TOLERANCE:
        least = float(residual.min())
        text = (
            f"{phase.name}: out of reach, none of {len(z)} configurations tried gets there; "
            f"the nearest stays {least:.3f} m or rad short"
        )
        return BlockedGoal(text, least, number)
    reached = z[residual < TOLERANCE]
    contacts = problem.contacts.evaluate(
        reached, np.full(len(reached), end), reach=problem.options.largest_margin
    )
    shortfall = contacts.compute_shortfall(len(reached))
    if shortfall.min() <= ACCEPTED_SHORTFALL:
        return None
    best = int(np.argmin(shortfall))
    worst = int(np.flatnonzero(contacts.waypoint == best)[0])
    labels = problem.contacts.phases[problem.contacts.find_phase(end)].labels
    first, second = (labels[shape] for shape in contacts.pair[worst])
    distance = 1e3 * contacts.distance[worst]
    gap = f"overlap by {-distance:.1f} mm" if distance < 0 else f"are only {distance:.1f} mm apart"
    text = (
        f"{phase.name}: all {len(reached)} configurations found there are blocked; "
        f"in the least blocked one {first} – {second} {gap}"
    )
    return BlockedGoal(text, float(shortfall[best]), number)


def describe_free_range(problem: TrajectoryProblem, number: int, random_seed: int) -> str:
    """Describe how far the goal of an `Actuate` step has collision-free configurations.

    The positions between start and goal are bisected, with samples at each. Nothing is proven.

    Returns:
        Joint positions, for example "hinge = 1.18 rad"; empty if the phase moves no joint to a
        goal of the task, or if nothing free is found.
    """
    phase, row = problem.task.phases[number], int(problem.ends[number]) - 1
    wanted = [
        f"{step.object}.{joint}"
        for step in problem.task.steps
        if isinstance(step, Actuate)
        for joint in step.joints
    ]
    names = [name for name in phase.values if name in wanted]
    begin = np.array([phase.initial_values[name] for name in names])
    columns = [problem.chain.index(name) for name in names]
    end = problem.lower[row, columns]
    if (begin == end).all():
        return ""
    free, least, most = None, 0.0, 1.0
    for _ in range(_BISECTIONS):
        share = (least + most) / 2
        values = np.round(begin + share * (end - begin), 3)  # so that the text is exact
        lower, upper = problem.lower.copy(), problem.upper.copy()
        lower[row, columns] = upper[row, columns] = values
        other, rng = problem.with_bounds(lower, upper), np.random.default_rng(random_seed)
        if _has_free_sample(other, row + 1, sample_goal_configurations(other, row + 1, rng)):
            free, least = values, share
        else:
            most = share
    if free is None:
        return ""
    return ", ".join(
        f"{name.partition('.')[2]} = {value:g} {problem.unit(name)}"
        for name, value in zip(names, free.tolist(), strict=True)
    )


def _has_free_sample(
    problem: TrajectoryProblem, waypoint: int, samples: tuple[Floats, Floats] | None
) -> bool:
    """Return whether one of the samples reaches the goal of a waypoint without collision."""
    if samples is None:
        return False
    z, residual = samples
    return bool(find_free_configurations(problem, z[residual < TOLERANCE], waypoint).any())


def _sample_goal(
    problem: TrajectoryProblem, waypoint: int, rng: np.random.Generator
) -> tuple[Floats, Floats] | None:
    """Sample goal configurations in up to `_MAX_BATCHES` batches, until one is collision-free."""
    batches: list[tuple[Floats, Floats]] = []
    for _ in range(_MAX_BATCHES):
        samples = sample_goal_configurations(problem, waypoint, rng)
        if samples is None:
            return None
        batches.append(samples)
        if _has_free_sample(problem, waypoint, samples):
            break
    z, residual = (np.concatenate(parts) for parts in zip(*batches, strict=True))
    return z, residual
