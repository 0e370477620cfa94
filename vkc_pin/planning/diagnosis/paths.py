"""Diagnoses whether a failed motion lacks a path of the base or of the arm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vkc_pin.planning.base_paths.base_path import shortest_path
from vkc_pin.planning.initialization.base_routes import BaseRoutes
from vkc_pin.planning.initialization.keyframes import (
    find_free_configurations,
    sample_goal_configurations,
)
from vkc_pin.planning.nlp.kinematic_problem import KinematicProblem
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.nlp.pose_goals import find_phase_spans
from vkc_pin.utils.arrays import Floats
from vkc_pin.validation.report import Report

_HEADINGS = 8  # base headings that are tried where the goal leaves the heading free


class PathDiagnosis(NamedTuple):
    """Phases of a failed motion without a path, according to searches. Nothing is proven.

    Attributes:
        lines: Explanations.
        is_cut_off: Whether the base finds no path from the start to the end of the first phase.
    """

    lines: list[str]
    is_cut_off: bool = False


def diagnose_paths(
    problem: KinematicProblem, z: Floats, report: Report, blocked: Sequence[str], random_seed: int
) -> PathDiagnosis:
    """Find the phases of a failed motion that have no path.

    Base paths are searched from where the motion begins a phase to the free configurations that are
    found for its goal. If there is none, or the goal is a base position, they are searched to where
    the motion ends the phase, within the limits there.

    Args:
        problem: Problem that could not be solved.
        z: Best motion z_1..z_N, shape (N, n).
        report: Its violations.
        blocked: Explanations of the initialization for phases without a base path.
        random_seed: Random seed.
    """
    if problem.chain.robot.base == "fixed":
        return PathDiagnosis(list(blocked))
    lines = []
    is_cut_off = False
    routes = BaseRoutes(problem)
    path = problem.waypoints(z)
    last = path[0, :3]
    for number, (phase, begin, end) in enumerate(find_phase_spans(problem.task)):
        lower = problem.lower[end - 1, :3]
        upper = problem.upper[end - 1, :3]
        start = last
        last = np.clip(path[end, :3], lower, upper)
        own_lines = [line for line in blocked if line.startswith(f"{phase.name}: ")]
        has_collision = _has_collision(report, begin, end)
        if problem.is_closed(phase) or not (own_lines or has_collision):
            lines += own_lines
            continue
        goals, description = _find_base_goals(problem, number, last, random_seed)
        with_arm_at_home = shortest_path(
            routes.get_grid(number, folded=False), start.tolist(), goals, smooth=False
        )
        with_arm_folded = shortest_path(
            routes.get_grid(number, folded=True), start.tolist(), goals, smooth=False
        )
        found = with_arm_at_home or with_arm_folded
        if found is not None:
            description = _format_place(found.poses[-1])
        ends = f"from {_format_place(start)} to {description}"
        if found is None:
            text = f"found no path for the base {ends}, and none with the arm folded"
            is_cut_off = is_cut_off or number == 0
        elif with_arm_at_home is None:
            text = (
                f"found no path for the base {ends} but with the arm folded, "
                "and none for the arm to there"
            )
        elif has_collision:
            text = f"found a path for the base {ends}, but none for the arm at the goal"
        else:
            lines += own_lines
            continue
        lines.append(f"{phase.name}: {text}")
    # Phases with the same name have the same explanations.
    return PathDiagnosis(list(dict.fromkeys(lines)), is_cut_off)


def _has_collision(report: Report, begin: int, end: int) -> bool:
    """Return whether a report has a collision from waypoint `begin` to `end`."""
    for violation in report.violations:
        is_collision = violation.constraint in ("penetration", "clearance")
        if is_collision and begin <= violation.waypoint <= end:
            return True
    return False


def _find_base_goals(
    problem: KinematicProblem, number: int, last: Floats, random_seed: int
) -> tuple[Floats, str]:
    """Return possible base poses, shape (G, 3), at the end of a phase, and their description.

    The motion ends the phase at base pose `last`.
    """
    end = int(problem.ends[number])
    if not problem.task.phases[number].configuration:
        rng = np.random.default_rng(random_seed)
        samples = sample_goal_configurations(problem, end, rng)
        if samples is not None:
            z, residual = samples
            reached = z[residual < TOLERANCE]
            free = reached[find_free_configurations(problem, reached, end)]
            if len(free):
                return free[:, :3], f"any of {len(free)} places from which the goal was reached"
    goals = np.tile(last, (_HEADINGS, 1))
    if problem.lower[end - 1, 2] < problem.upper[end - 1, 2]:
        goals[:, 2] += np.arange(_HEADINGS) * 2 * np.pi / _HEADINGS
    return goals, _format_place(last)


def _format_place(pose: Floats) -> str:
    x, y = pose[:2]
    return f"({x:.2f}, {y:.2f})"
