"""Adds clutter to a scene: small objects on horizontal surfaces, and pictures on walls."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import check_instance, check_integer
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.shapes import compute_world_box
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import Scene

_MAX_TRIES = 200  # places for one object
_GAP = 0.002  # [m] between an object and all shapes but its support
_REACH = 0.15  # [m] radius around free objects that stays clear for a hand
_TOPS = (0.2, 1.6)  # [m] heights of supporting surfaces
_MIN_SIDE = 0.12  # [m] of a supporting surface
_WALL = (0.2, 1.5)  # [m] largest thickness and smallest height of a wall
_SUNK = 0.005  # [m] depth of a picture in its wall
_COLOURS = (
    "blue",
    "brown",
    "cream",
    "green",
    "orange",
    "red",
    "teal",
    "terracotta",
    "white",
    "yellow",
)


@dataclass(frozen=True)
class _Face:
    """A rectangle in the world.

    Attributes:
        frame: Frame at its centre, x and y along its sides, z normal to it.
        half: Half of its side lengths, shape (2,) [m].
    """

    frame: pin.SE3
    half: Floats


def add_clutter(
    scene: Scene, count: int, *, seed: int = 0, clear: Sequence[tuple[Sequence[float], float]] = ()
) -> Scene:
    """Return a scene with small objects on horizontal surfaces, and pictures on its walls.

    Each is one convex shape: an obstacle `clutter_<number>`. A radius of 0.15 m around objects that
    can be carried stays free.

    Args:
        scene: Scene; it is not changed.
        count: Number of objects to add.
        seed: Random seed; the result is reproducible.
        clear: Further places that stay free: x, y, z and a radius [m] each.

    Raises:
        InputError: There is no space for so many objects.
    """
    count, seed = check_integer(count, "count", low=0), check_integer(seed, "seed", low=0)
    faces = _Faces(check_instance(scene, Scene, "scene"), clear)
    rng = np.random.default_rng([5, seed])
    placed = [faces.place(f"clutter_{number + 1}", rng) for number in range(count)]
    document = {**scene.document, "obstacles": [*scene.document.get("obstacles", ()), *placed]}
    return Scene.from_document(document, scene.folder)


class _Faces:
    """Surfaces on which clutter can be placed, and the boxes that are occupied."""

    def __init__(self, scene: Scene, clear: Sequence[tuple[Sequence[float], float]]) -> None:
        objects = scene.objects.values()
        shapes = [
            *scene.obstacles,
            *(shape for placed in objects for shape in make_world_shapes(placed)),
        ]
        self.boxes = [compute_world_box(shape.geometry, shape.placement) for shape in shapes]
        self.clear = [(np.array(place, float), float(radius)) for place, radius in clear]
        self.clear += [
            (placed.placement.translation, _REACH) for placed in objects if placed.object.free
        ]
        flat = [shape for shape in scene.obstacles if isinstance(shape.geometry, coal.Box)]
        self.tops = [face for shape in flat for face in _find_tops(shape)]
        self.walls = [face for shape in flat for face in _find_sides(shape, scene.arena)]
        areas = np.array([4.0 * face.half[0] * face.half[1] for face in (*self.tops, *self.walls)])
        areas[len(self.tops) :] *= 0.1  # most of a wall stays empty
        self.probabilities = areas / areas.sum() if len(areas) else areas

    def place(self, name: str, rng: np.random.Generator) -> dict[str, Any]:
        """Return an obstacle at a random free place, and mark that as occupied."""
        for _ in range(_MAX_TRIES if len(self.probabilities) else 0):
            number = int(rng.choice(len(self.probabilities), p=self.probabilities))
            is_picture = number >= len(self.tops)
            face = (*self.tops, *self.walls)[number]
            shape, size, sunk = _sample_picture(rng) if is_picture else _sample_object(rng)
            room = face.half - size[:2] / 2.0
            if (room <= 0.0).any():
                continue
            x, y = rng.uniform(-room, room)
            where = face.frame * pin.SE3(np.eye(3), np.array([x, y, size[2] / 2.0 - sunk]))
            extent = np.abs(where.rotation) @ size / 2.0
            box = where.translation - extent, where.translation + extent
            if self._is_free(box, face, sunk):
                self.boxes.append(box)
                rpy = [round(float(angle), 6) for angle in pin.rpy.matrixToRpy(where.rotation)]
                at = [round(float(value), 4) for value in where.translation]
                return {
                    "name": name,
                    **shape,
                    "position": at,
                    "rpy": rpy,
                    "colour": str(rng.choice(_COLOURS)),
                }
        expected = "fewer objects, or more tables and shelves"
        raise InputError("there is no space for so many objects", field="count", expected=expected)

    def _is_free(self, box: tuple[Floats, Floats], face: _Face, sunk: float) -> bool:
        """Return whether a box overlaps nothing but the surface that it rests or hangs on."""
        inside = (box[0] + box[1]) / 2.0
        if any(
            np.linalg.norm(np.maximum(np.abs(inside - at) - (box[1] - box[0]) / 2.0, 0.0)) < far
            for at, far in self.clear
        ):
            return False
        out = face.frame.rotation[:, 2]
        lift = (sunk + _GAP + 1e-6) * out  # off its support
        low, high = box[0] + lift - _GAP, box[1] + lift + _GAP
        lows, highs = (np.array(corners) for corners in zip(*self.boxes, strict=True))
        return not ((low < highs) & (high > lows)).all(axis=1).any()


def _find_tops(shape: pin.GeometryObject) -> Iterator[_Face]:
    """Yield the upper face of a box if objects can rest on it."""
    half, where = np.asarray(shape.geometry.halfSide, float), shape.placement
    axis = int(np.argmax(np.abs(where.rotation[2])))
    if abs(where.rotation[2, axis]) < 1.0 - 1e-9 or axis != 2:
        return
    top = where.translation + np.array([0.0, 0.0, half[2]])
    if _TOPS[0] <= top[2] <= _TOPS[1] and 2.0 * half[:2].min() >= _MIN_SIDE:
        yaw = math.atan2(where.rotation[1, 0], where.rotation[0, 0])
        yield _Face(pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, yaw), top), half[:2])


def _find_sides(shape: pin.GeometryObject, arena: Sequence[float]) -> Iterator[_Face]:
    """Yield those of the two large faces of a wall that are within the arena."""
    half, where = np.asarray(shape.geometry.halfSide, float), shape.placement
    thin = int(np.argmin(half[:2]))
    if (
        2.0 * half[thin] > _WALL[0]
        or 2.0 * half[2] < _WALL[1]
        or abs(where.rotation[2, 2]) < 1.0 - 1e-9
    ):
        return
    for side in (-1.0, 1.0):
        out = side * where.rotation[:, thin]
        up = np.array([0.0, 0.0, 1.0])
        middle = where.translation + half[thin] * out
        before = middle + 0.1 * out
        if arena[0] <= before[0] <= arena[1] and arena[2] <= before[1] <= arena[3]:
            yield _Face(
                pin.SE3(np.column_stack([np.cross(up, out), up, out]), middle),
                np.array([half[1 - thin], half[2]]),
            )


def _sample_object(rng: np.random.Generator) -> tuple[dict[str, Any], Floats, float]:
    """Return a random object's shape, its size with z up [m], and its depth in the surface, 0."""
    kind, u = int(rng.integers(4)), [float(value) for value in rng.random(3)]
    if kind == 0:  # a bottle or a glass
        radius, length = round(0.025 + 0.025 * u[0], 3), round(0.1 + 0.2 * u[1], 3)
    elif kind == 1:  # a plate or a bowl
        radius, length = round(0.06 + 0.07 * u[0], 3), round(0.02 + 0.06 * u[1], 3)
    else:  # a book or a box
        size = [
            round(low + more * value, 3)
            for low, more, value in zip((0.03, 0.1, 0.08), (0.15, 0.12, 0.2), u, strict=True)
        ]
        return {"type": "box", "size": size}, np.array(size), 0.0
    return (
        {"type": "cylinder", "radius": radius, "length": length},
        np.array([2 * radius, 2 * radius, length]),
        0.0,
    )


def _sample_picture(rng: np.random.Generator) -> tuple[dict[str, Any], Floats, float]:
    """Return a picture's box, its size with z normal to the wall, and its depth in the wall [m]."""
    size = [round(float(value), 3) for value in (*rng.uniform(0.15, 0.6, 2), 0.025)]
    return {"type": "box", "size": size}, np.array(size), _SUNK
