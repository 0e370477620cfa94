"""Diagnoses whether a failed motion lacks a path of the base or of the arm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vkc_pin.planning.base_paths.base_path import BasePath, shortest_path
from vkc_pin.planning.initialization.base_routes import BaseRoutes
from vkc_pin.planning.initialization.keyframes import compute_shortfall, sample_goal_configurations
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Floats
from vkc_pin.validation.report import Report
from vkc_pin.world.task.phases import Phase

__all__ = ["PathDiagnosis", "diagnose_paths"]

_HEADINGS = 8  # base headings that are tried where the goal leaves the heading free
_HITS = ("penetration", "clearance")


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
    the motion ends the phase.

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
    begins = np.concatenate([[0], problem.ends[:-1]])
    for number, (phase, begin, end) in enumerate(
        zip(problem.task.phases, begins, problem.ends, strict=True)
    ):
        own = [line for line in blocked if line.startswith(f"{phase.name}: ")]
        hit = [v for v in report.violations if v.constraint in _HITS and begin <= v.waypoint <= end]
        if problem.closed(phase) or not (own or hit):
            lines += own
            continue
        goals, where = _find_base_goals(problem, phase, path[end], int(end), random_seed)
        start = path[begin, :3]
        home, folded = (
            shortest_path(routes.get_grid(number, folded=how), start.tolist(), goals, smooth=False)
            for how in (False, True)
        )
        found = home or folded
        end_text = where if found is None else _describe_end(found)
        ends = f"from {_format_place(start)} to {end_text}"
        if found is None:
            lines.append(
                f"{phase.name}: found no path for the base {ends}, and none with the arm folded"
            )
            is_cut_off = is_cut_off or number == 0
        elif home is None:
            lines.append(
                f"{phase.name}: found no path for the base {ends} but with the arm folded, "
                "and none for the arm to there"
            )
        elif hit:
            lines.append(
                f"{phase.name}: found a path for the base {ends}, but none for the arm at the goal"
            )
        else:
            lines += own
    return PathDiagnosis(lines, is_cut_off)


def _find_base_goals(
    problem: TrajectoryProblem, phase: Phase, last: Floats, end: int, random_seed: int
) -> tuple[Floats, str]:
    """Return possible base poses at the end of a phase, and their description.

    Args:
        problem: Problem.
        phase: Phase.
        last: Configuration with which the motion ends the phase, shape (n,).
        end: Last waypoint of the phase.
        random_seed: Random seed.

    Returns:
        Poses, shape (G, 3), and text.
    """
    tried = (
        sample_goal_configurations(problem, end, np.random.default_rng(random_seed))
        if phase.base is None
        else None
    )
    if tried is not None:
        z = tried[0][tried[1] < TOLERANCE]
        free = z[compute_shortfall(problem, z, end) <= 0.0] if len(z) else z
        if len(free):
            return free[:, :3], f"any of {len(free)} places from which the goal was reached"
    goals = np.tile(last[:3], (_HEADINGS, 1))
    if problem.lower[end - 1, 2] < problem.upper[end - 1, 2]:
        goals[:, 2] += np.arange(_HEADINGS) * 2 * np.pi / _HEADINGS
    return goals, _format_place(last)


def _describe_end(path: BasePath) -> str:
    return _format_place(path.poses[-1])


def _format_place(pose: Floats) -> str:
    x, y = pose[:2]
    return f"({x:.2f}, {y:.2f})"
