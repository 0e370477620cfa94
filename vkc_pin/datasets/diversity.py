"""How different episodes are: near-duplicates, and on which sides of things the base goes."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = [
    "NEAR",
    "DuplicateFinder",
    "compute_coverage",
    "compute_winding_numbers",
    "sample_coarse_trajectory",
]

NEAR = 0.02
"""Two motions that are nowhere further apart than this in any coordinate, at equal shares of their time, are near-duplicates
[m] or [rad]."""
_MOMENTS = 9  # at which motions are compared
_GROUND = 1.6  # [m] what begins above that is nothing to drive around


def sample_coarse_trajectory(trajectory: Trajectory) -> list[list[float]]:
    """Return where robot and objects are at equal shares of a motion's time, to the millimetre, as plain data."""
    times = np.linspace(trajectory.times[0], trajectory.times[-1], _MOMENTS)
    return [[float(value) for value in row] for row in trajectory.at(times).round(3)]


class DuplicateFinder:
    """What is in a dataset already, to tell what is nearly the same."""

    def __init__(self) -> None:
        self._ways: dict[Hashable, list[tuple[int, Floats]]] = {}

    def find_duplicate(self, record: Mapping[str, Any]) -> int | None:
        """Return the number of an episode that is nearly the same as that of a record, None if there is none; note it then."""
        own = np.array(record["way"], float)
        goal = record.get("goal")
        group = (record["scene"], record["task"], record["object"], own.shape)
        known = self._ways.setdefault(group, [])
        if known:
            gaps = np.abs(np.array([other for _, other in known]) - own).max(axis=(1, 2))
            nearest = int(np.argmin(gaps))
            if gaps[nearest] < NEAR and goal is not None:
                return known[nearest][0]
        known.append((int(record["number"]), own))
        return None


def compute_winding_numbers(scene: Scene, trajectory: Trajectory) -> dict[str, int]:
    """Return around which things the base's path winds otherwise than the straight line from its start to its end.

    Two paths with the same ends can be deformed into each other, as far as winding tells, if this
    is the same; see Bhattacharya, Likhachev and Kumar, "Topological constraints in search-based
    robot path planning", Autonomous Robots 33 (2012).

    Returns:
        Obstacle or object → whole turns, those that are not 0: positive where the path leaves it to
        its left.
    """
    path = _path(trajectory)
    found = {}
    for name, point in _posts(scene).items():
        turned = _turn(path - point)
        straight = _turn(path[[0, -1]] - point)
        turns = round((turned - straight) / (2.0 * np.pi))
        if turns:
            found[name] = int(turns)
    return found


def _path(trajectory: Trajectory) -> Floats:
    """Return points of the base's path, shape (K, 2) [m]."""
    times = np.linspace(trajectory.times[0], trajectory.times[-1], 8 * len(trajectory.times))
    return np.asarray(trajectory.at(times)[:, :2])


def _turn(seen: Floats) -> float:
    """Return the angle by which a path turns about the origin, both ends included [rad]."""
    angles = np.unwrap(np.arctan2(seen[:, 1], seen[:, 0]))
    return float(angles[-1] - angles[0])


def _posts(scene: Scene) -> dict[str, Floats]:
    """Return where the obstacles that stand on the floor are, by name, and the objects that do not move."""
    found: dict[str, Floats] = {}
    for shape, label in zip(scene.obstacles, scene.obstacle_labels, strict=True):
        where = shape.placement.translation
        if label != "floor" and where[2] < _GROUND and not label.startswith("wall_"):
            found.setdefault(label, np.array(where[:2]))
    for name, placed in scene.objects.items():
        if not placed.object.free:
            found[name] = np.array(placed.placement.translation[:2])
    return found


def compute_coverage(values: Sequence[float], low: float, high: float, cells: int = 10) -> float:
    """Return the share of equal cells of an interval in which there is a value."""
    if high <= low or not len(values):
        return 0.0
    cell = np.clip(
        ((np.asarray(values, float) - low) / (high - low) * cells).astype(int), 0, cells - 1
    )
    return len(set(cell.tolist())) / cells
