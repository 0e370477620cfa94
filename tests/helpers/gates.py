"""Makes problems of driving past the end of a wall or through a gate in it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import vkc_pin as vkc
from helpers.drives import make_hall
from helpers.small_problems import make_program

NARROW = 0.73  # [m]; the base is 0.67 wide, the arm at home 0.72, and the margin 0.02
TOO_NARROW = 0.70  # [m]; narrower than the arm at home
GOAL = (4.0, 0.5, 0.0)


def _make_problem(
    obstacles: Sequence[dict[str, Any]], goal: Sequence[float]
) -> vkc.TrajectoryProblem:
    scene = make_hall(obstacles=obstacles)
    document = {**scene.document, "arena": {"x": [-3.0, 6.0], "y": [-3.0, 3.0]}}
    return make_program(vkc.Scene.from_document(document, scene.folder), [vkc.GoTo(*goal)])


def make_wall_problem(gap: float) -> vkc.TrajectoryProblem:
    """Return the problem of driving through the `gap` [m] at the end of a wall across the hall."""
    wall = {
        "name": "wall",
        "type": "box",
        "size": [0.2, 6.0 - gap, 1.5],
        "position": [2.0, gap / 2, 0.75],
    }
    return _make_problem([wall], (4.0, 1.5, 0.0))


def make_gate_problem(width: float, *, height: float = 1.5) -> vkc.TrajectoryProblem:
    """Return the problem of driving through a gate of `width` [m] in a wall across the hall."""
    size = (6.4 - width) / 2
    return _make_problem(
        [
            {
                "name": name,
                "type": "box",
                "size": [0.2, size, height],
                "position": [2.0, side * (size + width) / 2, height / 2],
            }
            for name, side in (("left", 1.0), ("right", -1.0))
        ],
        GOAL,
    )


def make_waypoint(problem: vkc.TrajectoryProblem, pose: Sequence[float]) -> np.ndarray:
    """Return the problem's start with another base pose, shape (n,)."""
    return np.concatenate([pose, problem.start[3:]])
