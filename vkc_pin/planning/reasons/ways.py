"""Whether it is the base that finds no way, with the arm at home or folded, or the arm, where a motion hits things."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vkc_pin.arrays import Floats
from vkc_pin.driving.path import shortest_path
from vkc_pin.program.problem import TrajectoryProblem
from vkc_pin.seeds.routes import Routes
from vkc_pin.validation.report import Report

__all__ = ["ways"]

_HEADINGS = 8  # in which the base may stand at an end where the goal asks for none
_HITS = ("penetration", "clearance")


def ways(problem: TrajectoryProblem, z: Floats, report: Report, blocked: Sequence[str]) -> list[str]:
    """Return lines about the phases in which a motion that failed has no way, as far as searches say; none proves nothing.

    The base's ways are looked for from where the motion begins a phase to where it ends it.

    Args:
        problem: What could not be solved.
        z: The best motion's z_1..z_N, shape (N, n).
        report: What is violated by it.
        blocked: What the search for seeds says of phases without a way for the base.
    """
    if problem.chain.robot.base == "fixed":
        return list(blocked)
    lines, routes, path = [], Routes(problem), problem.waypoints(z)
    begins = np.concatenate([[0], problem.ends[:-1]])
    for number, (phase, begin, end) in enumerate(zip(problem.task.phases, begins, problem.ends, strict=True)):
        own = [line for line in blocked if line.startswith(f"{phase.name}: ")]
        hit = [v for v in report.violations if v.constraint in _HITS and begin <= v.waypoint <= end]
        if problem.closed(phase) or not (own or hit):
            lines += own
            continue
        start, goals = path[begin, :3], np.tile(path[end, :3], (_HEADINGS, 1))
        if problem.lower[end - 1, 2] < problem.upper[end - 1, 2]:
            goals[:, 2] += np.arange(_HEADINGS) * 2 * np.pi / _HEADINGS
        (x, y), (u, v) = start[:2], goals[0, :2]
        where = f"from ({x:.2f}, {y:.2f}) to ({u:.2f}, {v:.2f})"
        home, folded = (
            shortest_path(routes.grid(number, folded=how), start.tolist(), goals, smooth=False) is not None
            for how in (False, True)
        )
        if not (home or folded):
            lines.append(f"{phase.name}: found no way for the base {where}, and none with the arm folded")
        elif not home:
            lines.append(
                f"{phase.name}: found no way for the base {where} but with the arm folded, and none for the arm to there"
            )
        elif hit:
            lines.append(f"{phase.name}: found a way for the base {where}, but none for the arm at the goal")
        else:
            lines += own
    return lines
