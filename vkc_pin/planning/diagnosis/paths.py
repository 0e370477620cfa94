"""Whether it is the base that finds no way, with the arm at home or folded, or the arm, where a motion hits things."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vkc_pin.planning.base_paths.base_path import BasePath, shortest_path
from vkc_pin.planning.initialization.base_routes import Routes
from vkc_pin.planning.initialization.keyframes import depth, scatter
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Floats
from vkc_pin.validation.report import Report
from vkc_pin.world.task.phases import Phase

__all__ = ["Ways", "ways"]

_HEADINGS = 8  # in which the base may stand at an end where the goal asks for none
_HITS = ("penetration", "clearance")


class Ways(NamedTuple):
    """What searches say of the phases in which a motion that failed has no way; none of it proves anything.

    Attributes:
        lines: For people.
        cut_off: Whether the base finds none from where all begins to where its first phase may end.
    """

    lines: list[str]
    cut_off: bool = False


def ways(
    problem: TrajectoryProblem, z: Floats, report: Report, blocked: Sequence[str], random_seed: int
) -> Ways:
    """Return in which phases a motion that failed has no way, as far as searches say.

    The base's ways are looked for from where the motion begins a phase to where it may end it: at
    any of the free configurations that are found for the goal; if none is, or the goal is the
    base's place, where the motion ends it.

    Args:
        problem: What could not be solved.
        z: The best motion's z_1..z_N, shape (N, n).
        report: What is violated by it.
        blocked: What the search for seeds says of phases without a way for the base.
        random_seed: Of the configurations.
    """
    if problem.chain.robot.base == "fixed":
        return Ways(list(blocked))
    lines, routes, path, cut_off = [], Routes(problem), problem.waypoints(z), False
    begins = np.concatenate([[0], problem.ends[:-1]])
    for number, (phase, begin, end) in enumerate(
        zip(problem.task.phases, begins, problem.ends, strict=True)
    ):
        own = [line for line in blocked if line.startswith(f"{phase.name}: ")]
        hit = [v for v in report.violations if v.constraint in _HITS and begin <= v.waypoint <= end]
        if problem.closed(phase) or not (own or hit):
            lines += own
            continue
        goals, where = _goals(problem, phase, path[end], int(end), random_seed)
        start = path[begin, :3]
        home, folded = (
            shortest_path(routes.grid(number, folded=how), start.tolist(), goals, smooth=False)
            for how in (False, True)
        )
        leads = f"from {_place(start)} to {where if (way := home or folded) is None else _end(way)}"
        if way is None:
            lines.append(
                f"{phase.name}: found no way for the base {leads}, and none with the arm folded"
            )
            cut_off = cut_off or number == 0
        elif home is None:
            lines.append(
                f"{phase.name}: found no way for the base {leads} but with the arm folded, and none for the arm to there"
            )
        elif hit:
            lines.append(
                f"{phase.name}: found a way for the base {leads}, but none for the arm at the goal"
            )
        else:
            lines += own
    return Ways(lines, cut_off)


def _goals(
    problem: TrajectoryProblem, phase: Phase, last: Floats, end: int, random_seed: int
) -> tuple[Floats, str]:
    """Return where the base may stand at a phase's end, shape (G, 3), and that in words; `last` is where a motion ends it."""
    tried = (
        scatter(problem, end, np.random.default_rng(random_seed)) if phase.base is None else None
    )
    if tried is not None:
        z = tried[0][tried[1] < TOLERANCE]
        free = z[depth(problem, z, end) <= 0.0] if len(z) else z
        if len(free):
            return free[:, :3], f"any of {len(free)} places from which the goal was reached"
    goals = np.tile(last[:3], (_HEADINGS, 1))
    if problem.lower[end - 1, 2] < problem.upper[end - 1, 2]:
        goals[:, 2] += np.arange(_HEADINGS) * 2 * np.pi / _HEADINGS
    return goals, _place(last)


def _end(way: BasePath) -> str:
    return _place(way.poses[-1])


def _place(pose: Floats) -> str:
    x, y = pose[:2]
    return f"({x:.2f}, {y:.2f})"
