"""Measures the diversity of episodes: near-duplicates, homotopy classes and coverage."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory

NEAR = 0.02
"""Largest difference of near-duplicates in any coordinate [m] or [rad].

Trajectories are compared at equal fractions of their durations."""
# times at which trajectories are compared
_SAMPLES = 9
# [m] height above which obstacles do not block the base
_GROUND = 1.6


def sample_coarse_trajectory(trajectory: Trajectory) -> list[list[float]]:
    """Return the coordinates at equally spaced times, rounded to 1 mm, as plain data."""
    times = np.linspace(trajectory.times[0], trajectory.times[-1], _SAMPLES)
    rows: list[list[float]] = trajectory.at(times).round(3).tolist()
    return rows


class DuplicateFinder:
    """Finds near-duplicates of the episodes seen so far."""

    def __init__(self) -> None:
        self._trajectories: dict[Hashable, list[tuple[int, Floats]]] = {}

    def find_duplicate(self, record: Mapping[str, Any]) -> int | None:
        """Return the number of a near-duplicate episode; if there is none, add the record."""
        trajectory = np.array(record["way"], float)
        goal = record.get("goal")
        group = (record["scene"], record["task"], record["object"], trajectory.shape)
        known = self._trajectories.setdefault(group, [])
        if known:
            others = np.array([other for _, other in known])
            differences = np.abs(others - trajectory).max(axis=(1, 2))
            nearest = int(np.argmin(differences))
            if differences[nearest] < NEAR and goal is not None:
                return known[nearest][0]
        known.append((int(record["number"]), trajectory))
        return None


def compute_winding_numbers(scene: Scene, trajectory: Trajectory) -> dict[str, int]:
    """Return the winding numbers of the base path relative to the straight line between its ends.

    Paths with the same ends and winding numbers can be deformed into each other, as far as winding
    numbers tell; see Bhattacharya, Likhachev and Kumar, "Topological constraints in search-based
    robot path planning", Autonomous Robots 33 (2012).

    Returns:
        Maps obstacles and objects to nonzero winding numbers, positive where the path passes with
        the obstacle on its left.
    """
    path = _sample_base_path(trajectory)
    numbers: dict[str, int] = {}
    for name, point in _find_obstacle_positions(scene).items():
        rotation = _compute_rotation(path - point)
        straight = _compute_rotation(path[[0, -1]] - point)
        turns = round((rotation - straight) / (2.0 * np.pi))
        if turns:
            numbers[name] = int(turns)
    return numbers


def _sample_base_path(trajectory: Trajectory) -> Floats:
    """Return points of the base path, shape (K, 2) [m]."""
    times = np.linspace(trajectory.times[0], trajectory.times[-1], 8 * len(trajectory.times))
    return np.asarray(trajectory.at(times)[:, :2])


def _compute_rotation(points: Floats) -> float:
    """Return the angle by which a path rotates about the origin [rad]."""
    angles = np.unwrap(np.arctan2(points[:, 1], points[:, 0]))
    return float(angles[-1] - angles[0])


def _find_obstacle_positions(scene: Scene) -> dict[str, Floats]:
    """Return the positions of obstacles on the floor and of fixed objects, by name."""
    positions: dict[str, Floats] = {}
    for shape, label in zip(scene.obstacles, scene.obstacle_labels, strict=True):
        position = shape.placement.translation
        is_on_floor = label != "floor" and position[2] < _GROUND
        if is_on_floor and not label.startswith("wall_"):
            positions.setdefault(label, np.array(position[:2]))
    for name, placed in scene.objects.items():
        if not placed.object.free:
            positions[name] = np.array(placed.placement.translation[:2])
    return positions


def compute_coverage(values: Sequence[float], low: float, high: float, cells: int = 10) -> float:
    """Return the fraction of equal cells of an interval that contain a value."""
    if high <= low or not len(values):
        return 0.0
    fractions = (np.asarray(values, float) - low) / (high - low)
    numbers = np.clip((fractions * cells).astype(int), 0, cells - 1)
    return len(set(numbers.tolist())) / cells
