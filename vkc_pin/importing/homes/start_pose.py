"""Finds where a robot can start in a home: in the room from which it gets to most."""

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

_BASE = 1  # the joint of a robot's base
_CELL = 0.1  # [m]
_BEFORE = 0.9  # [m] from a handle to where a robot stands that takes it, about
_NEAR = 0.5  # [m] around that which count
_TRIES = 4000  # places
_CHOICE = 12  # free places of which the clearest is taken


def find_free_start(scene: Scene, rng: np.random.Generator) -> tuple[Scene, int]:
    """Return the scene with a start that is free, on the floor from which most objects are reached, and how many these are.

    All that moves counts as shut. The floor is judged by discs inside the base; the start with all
    of the robot.

    Args:
        scene: The scene.
        rng: Where random numbers come from.

    Raises:
        InputError: There is no free place.
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
    for fronts in _fronts(scene).values():
        near = np.zeros(cells.shape, bool)
        for front in fronts:
            near |= np.linalg.norm(middles - front, axis=-1) < _NEAR
        reached[np.setdiff1d(regions[near], [0])] += 1
    order = sorted(range(1, count + 1), key=lambda k: (-reached[k], -int((regions == k).sum())))
    for region in order:
        places = middles[regions == region]
        draws = (
            scene.with_start(base=_drawn(places, rng, low, high))
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
    problem = f"no place on the floor is {START_CLEARANCE} m from everything for {robot.name}"
    expected = "a home with room for the robot, its floor at the height `floor`"
    raise InputError(
        problem, field="robot, floor", expected=expected, got=f"none in {_TRIES} tries"
    )


def _drawn(places: Floats, rng: np.random.Generator, low: Floats, high: Floats) -> list[float]:
    """Return a random place in one of some cells, and a heading."""
    place = places[int(rng.integers(len(places)))] + rng.uniform(-0.5, 0.5, 2) * _CELL
    return [
        *np.clip(place, low, high).round(3).tolist(),
        round(float(rng.uniform(-np.pi, np.pi)), 3),
    ]


def _fronts(scene: Scene) -> dict[str, list[Floats]]:
    """Return before which places a robot stands that takes an object, shape (2,) [m]."""
    found: dict[str, list[Floats]] = {}
    for name, placed in scene.objects.items():
        for attachment in placed.object.attachments.values():
            tool = placed.link_placement(attachment.link) * attachment.placement
            way = tool.rotation[:2, 2]
            length = float(np.linalg.norm(way))
            back = -way / length if length > 0.5 else np.zeros(2)
            found.setdefault(name, []).append(tool.translation[:2] + _BEFORE * back)
    return found
