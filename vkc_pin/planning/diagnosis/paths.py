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
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.nlp.problem import TrajectoryProblem
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
    problem: TrajectoryProblem, z: Floats, report: Report, blocked: Sequence[str], random_seed: int
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
    lines, routes, path, is_cut_off = [], BaseRoutes(problem), problem.waypoints(z), False
    begin, last = 0, path[0, :3]
    for number, (phase, end) in enumerate(
        zip(problem.task.phases, problem.ends.tolist(), strict=True)
    ):
        lower, upper = problem.lower[end - 1, :3], problem.upper[end - 1, :3]
        start, last = last, np.clip(path[end, :3], lower, upper)
        own = [line for line in blocked if line.startswith(f"{phase.name}: ")]
        is_hit = any(
            v.constraint in ("penetration", "clearance") and begin <= v.waypoint <= end
            for v in report.violations
        )
        begin = end
        if problem.is_closed(phase) or not (own or is_hit):
            lines += own
            continue
        goals, where = _find_base_goals(problem, number, last, random_seed)
        home, folded = (
            shortest_path(routes.get_grid(number, folded=how), start.tolist(), goals, smooth=False)
            for how in (False, True)
        )
        found = home or folded
        ends = f"from {_format_place(start)} to "
        ends += where if found is None else _format_place(found.poses[-1])
        if found is None:
            text = f"found no path for the base {ends}, and none with the arm folded"
            is_cut_off = is_cut_off or number == 0
        elif home is None:
            text = (
                f"found no path for the base {ends} but with the arm folded, "
                "and none for the arm to there"
            )
        elif is_hit:
            text = f"found a path for the base {ends}, but none for the arm at the goal"
        else:
            lines += own
            continue
        lines.append(f"{phase.name}: {text}")
    # Phases with the same name have the same explanations.
    return PathDiagnosis(list(dict.fromkeys(lines)), is_cut_off)


def _find_base_goals(
    problem: TrajectoryProblem, number: int, last: Floats, random_seed: int
) -> tuple[Floats, str]:
    """Return possible base poses, shape (G, 3), at the end of a phase, and their description.

    The motion ends the phase at base pose `last`.
    """
    end = int(problem.ends[number])
    if not problem.task.phases[number].configuration:
        rng = np.random.default_rng(random_seed)
        samples = sample_goal_configurations(problem, end, rng)
        if samples is not None:
            z = samples[0][samples[1] < TOLERANCE]
            free = z[find_free_configurations(problem, z, end)]
            if len(free):
                return free[:, :3], f"any of {len(free)} places from which the goal was reached"
    goals = np.tile(last, (_HEADINGS, 1))
    if problem.lower[end - 1, 2] < problem.upper[end - 1, 2]:
        goals[:, 2] += np.arange(_HEADINGS) * 2 * np.pi / _HEADINGS
    return goals, _format_place(last)


def _format_place(pose: Floats) -> str:
    x, y = pose[:2]
    return f"({x:.2f}, {y:.2f})"
