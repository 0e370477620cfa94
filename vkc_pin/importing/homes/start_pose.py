"""Finds a start pose of a robot in a home, in the room from which it reaches most objects."""

from __future__ import annotations

import itertools

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.planning.base_paths.reachable_floor import CellGrid, InscribedDiscs, find_blocked_cells
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.shapes import list_placed_shapes
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import START_CLEARANCE, Scene

__all__ = ["find_free_start"]

_BASE = 1  # joint number of a robot's base
_CELL = 0.1  # [m] edge of a grid cell
_STANDOFF = 0.9  # [m] typical distance of a robot's base from a handle that it grasps
_RADIUS = 0.5  # [m] around this position within which free floor counts as reaching the handle
_TRIES = 4000  # sampled poses
_CHOICE = 12  # free poses of which the one with the largest clearance is chosen


def find_free_start(scene: Scene, rng: np.random.Generator) -> tuple[Scene, int]:
    """Return the scene with a free start pose, and the number of objects that it reaches.

    The start is on the connected floor from which most objects can be reached. All joints count as
    closed. The floor is checked with discs inside the base, the start with the whole robot.

    Args:
        scene: The scene.
        rng: Random generator.

    Raises:
        InputError: There is no free pose.
    """
    from scipy import ndimage

    robot, arena = scene.robot, scene.arena
    low, high = np.array([arena[0], arena[2]]), np.array([arena[1], arena[3]])
    base = [shape for shape in robot.collision.geometryObjects if shape.parentJoint == _BASE]
    standing = [
        shape
        for shape, label in zip(scene.obstacles, scene.obstacle_labels, strict=True)
        if label != FLOOR
    ]
    for placed in scene.objects.values():
        standing += make_world_shapes(placed)
    cells = CellGrid.over(low, high, _CELL)
    free = np.ones(cells.shape, bool)
    for wall in InscribedDiscs(list_placed_shapes(base)).make_walls(list_placed_shapes(standing)):
        window, own = find_blocked_cells(cells, wall, 0.0)
        free[window] &= ~own
    regions, count = ndimage.label(free)
    middles = np.stack(np.broadcast_arrays(*cells.centers()), axis=-1)
    reached = np.zeros(count + 1, int)
    for positions in _find_grasp_positions(scene).values():
        near = np.zeros(cells.shape, bool)
        for position in positions:
            near |= np.linalg.norm(middles - position, axis=-1) < _RADIUS
        reached[np.setdiff1d(regions[near], [0])] += 1
    order = sorted(range(1, count + 1), key=lambda k: (-reached[k], -int((regions == k).sum())))
    for region in order:
        places = middles[regions == region]
        draws = (
            scene.with_start(base=_sample_pose(places, rng, low, high))
            for _ in range(_TRIES // len(order) + 1)
        )
        found = list(
            itertools.islice(
                ((s, c) for s in draws if (c := s.start_clearance(reach=1.0)) >= START_CLEARANCE),
                _CHOICE,
            )
        )
        if found:
            return max(found, key=lambda entry: entry[1])[0], int(reached[region])
    problem = f"no start pose of {robot.name} has a clearance of {START_CLEARANCE} m"
    expected = "a home with free floor for the robot, at the height `floor`"
    raise InputError(
        problem, field="robot, floor", expected=expected, got=f"none in {_TRIES} tries"
    )


def _sample_pose(
    places: Floats, rng: np.random.Generator, low: Floats, high: Floats
) -> list[float]:
    """Return a random position in one of some cells, and a random heading."""
    place = places[int(rng.integers(len(places)))] + rng.uniform(-0.5, 0.5, 2) * _CELL
    return [
        *np.clip(place, low, high).round(3).tolist(),
        round(float(rng.uniform(-np.pi, np.pi)), 3),
    ]


def _find_grasp_positions(scene: Scene) -> dict[str, list[Floats]]:
    """Return the base positions from which a robot grasps each object, shape (2,) [m] each."""
    found: dict[str, list[Floats]] = {}
    for name, placed in scene.objects.items():
        for attachment in placed.object.attachments.values():
            tool = placed.link_placement(attachment.link) * attachment.placement
            direction = tool.rotation[:2, 2]
            length = float(np.linalg.norm(direction))
            back = -direction / length if length > 0.5 else np.zeros(2)
            found.setdefault(name, []).append(tool.translation[:2] + _STANDOFF * back)
    return found
