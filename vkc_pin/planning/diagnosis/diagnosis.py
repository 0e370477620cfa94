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
from vkc_pin.planning.nlp.kinematic_problem import KinematicProblem
from vkc_pin.planning.nlp.merit import TOLERANCE
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


def find_impossible_conditions(problem: KinematicProblem) -> list[Violation]:
    """Find violations that no motion can change, at the start or of goals beyond limits.

    They name waypoints, but no times, which depend on the motion in the plan.
    """
    found = _find_collisions_at_start(problem)
    found += _find_open_closures_at_start(problem)
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


def _find_collisions_at_start(problem: KinematicProblem) -> list[Violation]:
    """Find the pairs of links that overlap at the start by more than the scene allows."""
    contacts = problem.contacts.evaluate(problem.start[None], np.array([0]), reach=0.0)
    labels = problem.contacts.phases[0].labels
    deepest = dict[str, float]()  # links of several shapes count once
    for (first, second), distance, margin in zip(
        contacts.pair, contacts.distance, contacts.margin, strict=True
    ):
        # Margins may be negative where the scene allows contact.
        least = margin if margin > CONTACT_DEPTH else margin - CONTACT_DEPTH
        if distance < least:
            subject = f"{labels[first]} – {labels[second]}"
            deepest[subject] = min(float(distance), deepest.get(subject, np.inf))
    violations = []
    for subject, distance in deepest.items():
        depth = f"{-1e3 * distance:.1f}"
        detail = "touch at the start" if depth == "0.0" else f"overlap by {depth} mm at the start"
        violations.append(Violation("start", subject, amount=-distance, unit="m", detail=detail))
    return violations


def _find_open_closures_at_start(problem: KinematicProblem) -> list[Violation]:
    """Find the grasps of the start that the hand does not have there."""
    violations = []
    for goal, solver in zip(problem.pose_goals, problem.pose_solvers, strict=True):
        is_closure_of_start = goal.kind == "closure" and 1 in goal.row.waypoints
        if not is_closure_of_start or goal.object not in problem.scene.held:
            continue
        residual, _ = solver.evaluate(problem.start[None], goal.target)
        error = float(np.abs(residual).max())
        if error <= Tolerances().closure_position:
            continue
        detail = (
            f"it is grasped at the start, but the hand is {error:.4f} m or rad from its attachment"
        )
        with contextlib.suppress(InputError):
            problem.scene.with_measured_grasp(goal.object)
            detail += "; if it is there, see Scene.with_measured_grasp"
        violations.append(Violation("closure", goal.about, amount=error, unit="m", detail=detail))
    return violations


def _find_collisions_at_goal(problem: KinematicProblem, end: int) -> list[Violation]:
    """Find the pairs that are too close at a waypoint whatever the coordinates left free are."""
    lower = problem.lower[end - 1]
    upper = problem.upper[end - 1]
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


def diagnose_goals(problem: KinematicProblem, random_seed: int) -> list[BlockedGoal]:
    """Explain all goals of an unsolved problem without a known collision-free configuration."""
    blocked = []
    for number in range(len(problem.task.phases)):
        goal = diagnose_goal(problem, number, random_seed)
        if goal is not None:
            blocked.append(goal)
    return blocked


def diagnose_goal(problem: KinematicProblem, number: int, random_seed: int) -> BlockedGoal | None:
    """Explain the goal of one phase; None if it has a collision-free configuration."""
    phase = problem.task.phases[number]
    end = int(problem.ends[number])
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
    first, second = contacts.pair[worst]
    distance = 1e3 * contacts.distance[worst]
    gap = f"overlap by {-distance:.1f} mm" if distance < 0 else f"are only {distance:.1f} mm apart"
    text = (
        f"{phase.name}: all {len(reached)} configurations found there are blocked; "
        f"in the least blocked one {labels[first]} – {labels[second]} {gap}"
    )
    return BlockedGoal(text, float(shortfall[best]), number)


def describe_free_range(problem: KinematicProblem, number: int, random_seed: int) -> str:
    """Describe how far the goal of an `Actuate` step has collision-free configurations.

    The positions between start and goal are bisected, with samples at each. Nothing is proven.

    Returns:
        Joint positions, for example "hinge = 1.18 rad"; empty if the phase moves no joint to a
        goal of the task, or if nothing free is found.
    """
    phase = problem.task.phases[number]
    row = int(problem.ends[number]) - 1
    goals_of_task = set[str]()
    for step in problem.task.steps:
        if isinstance(step, Actuate):
            goals_of_task.update(f"{step.object}.{joint}" for joint in step.joints)
    names = [name for name in phase.values if name in goals_of_task]
    begin = np.array([phase.initial_values[name] for name in names])
    columns = [problem.chain.index(name) for name in names]
    end = problem.lower[row, columns]
    if (begin == end).all():
        return ""
    free = None
    # fractions of the displacement: the largest free one, and the smallest without a free sample
    least = 0.0
    most = 1.0
    for _ in range(_BISECTIONS):
        s = (least + most) / 2
        values = np.round(begin + s * (end - begin), 3)  # so that the text is exact
        lower = problem.lower.copy()
        upper = problem.upper.copy()
        lower[row, columns] = values
        upper[row, columns] = values
        other = problem.with_bounds(lower, upper)
        rng = np.random.default_rng(random_seed)
        samples = sample_goal_configurations(other, row + 1, rng)
        if _has_free_sample(other, row + 1, samples):
            free = values
            least = s
        else:
            most = s
    if free is None:
        return ""
    parts = []
    for name, value in zip(names, free.tolist(), strict=True):
        _, _, joint = name.partition(".")
        parts.append(f"{joint} = {value:g} {problem.unit(name)}")
    return ", ".join(parts)


def _has_free_sample(
    problem: KinematicProblem, waypoint: int, samples: tuple[Floats, Floats] | None
) -> bool:
    """Return whether one of the samples reaches the goal of a waypoint without collision."""
    if samples is None:
        return False
    z, residual = samples
    return bool(find_free_configurations(problem, z[residual < TOLERANCE], waypoint).any())


def _sample_goal(
    problem: KinematicProblem, waypoint: int, rng: np.random.Generator
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
    z = np.concatenate([configurations for configurations, _ in batches])
    residual = np.concatenate([residuals for _, residuals in batches])
    return z, residual
