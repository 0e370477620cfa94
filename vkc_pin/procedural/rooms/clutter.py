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

# places for one object
_MAX_TRIES = 200
# [m] between an object and all shapes but its support
_GAP = 0.002
# [m] radius around free objects that stays clear for a hand
_REACH = 0.15
# [m] heights of supporting surfaces
_MIN_TOP = 0.2
_MAX_TOP = 1.6
# [m] of a supporting surface
_MIN_SIDE = 0.12
# [m] largest thickness and smallest height of a wall
_MAX_THICKNESS = 0.2
_MIN_HEIGHT = 1.5
# [m] depth of a picture in its wall
_SUNK = 0.005
# Most of a wall stays empty.
_WALL_WEIGHT = 0.1
# cosine of the angle up to which an axis is vertical
_VERTICAL = 1.0 - 1e-9
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
    count = check_integer(count, "count", low=0)
    seed = check_integer(seed, "seed", low=0)
    faces = _Faces(check_instance(scene, Scene, "scene"), clear)
    rng = np.random.default_rng([5, seed])
    placed = [faces.place(f"clutter_{number + 1}", rng) for number in range(count)]
    document = scene.document
    document["obstacles"] = [*document.get("obstacles", ()), *placed]
    return Scene.from_document(document, scene.folder)


class _Faces:
    """Surfaces on which clutter can be placed, and the boxes that are occupied."""

    def __init__(self, scene: Scene, clear: Sequence[tuple[Sequence[float], float]]) -> None:
        shapes = list(scene.obstacles)
        self.clear = [(np.array(place, float), float(radius)) for place, radius in clear]
        for placed in scene.objects.values():
            shapes += make_world_shapes(placed)
            if placed.object.free:
                self.clear.append((placed.placement.translation, _REACH))
        self.boxes = [compute_world_box(shape.geometry, shape.placement) for shape in shapes]
        tops: list[_Face] = []
        walls: list[_Face] = []
        for shape in scene.obstacles:
            if isinstance(shape.geometry, coal.Box):
                tops += _find_tops(shape)
                walls += _find_sides(shape, scene.arena)
        self.faces = [*tops, *walls]
        self.top_count = len(tops)
        areas = np.array([4.0 * face.half[0] * face.half[1] for face in self.faces])
        areas[self.top_count :] *= _WALL_WEIGHT
        self.probabilities = areas / areas.sum() if len(areas) else areas

    def place(self, name: str, rng: np.random.Generator) -> dict[str, Any]:
        """Return an obstacle at a random free place, and mark that as occupied."""
        if self.faces:
            for _ in range(_MAX_TRIES):
                obstacle = self._try_place(name, rng)
                if obstacle is not None:
                    return obstacle
        expected = "fewer objects, or more tables and shelves"
        raise InputError("there is no space for so many objects", field="count", expected=expected)

    def _try_place(self, name: str, rng: np.random.Generator) -> dict[str, Any] | None:
        """Return an obstacle at a random place, or None if that is not free."""
        number = int(rng.choice(len(self.probabilities), p=self.probabilities))
        face = self.faces[number]
        is_picture = number >= self.top_count
        shape, size, sunk = _sample_picture(rng) if is_picture else _sample_object(rng)
        margin = face.half - size[:2] / 2.0
        if (margin <= 0.0).any():
            return None
        x, y = rng.uniform(-margin, margin)
        place = face.frame * pin.SE3(np.eye(3), np.array([x, y, size[2] / 2.0 - sunk]))
        extent = np.abs(place.rotation) @ size / 2.0
        box = (place.translation - extent, place.translation + extent)
        if not self._is_free(box, face, sunk):
            return None
        self.boxes.append(box)
        return {
            "name": name,
            **shape,
            "position": [round(float(value), 4) for value in place.translation],
            "rpy": [round(float(angle), 6) for angle in pin.rpy.matrixToRpy(place.rotation)],
            "colour": str(rng.choice(_COLOURS)),
        }

    def _is_free(self, box: tuple[Floats, Floats], face: _Face, sunk: float) -> bool:
        """Return whether a box overlaps nothing but the surface that it rests or hangs on."""
        lower, upper = box
        centre = (lower + upper) / 2.0
        half = (upper - lower) / 2.0
        for point, radius in self.clear:
            outside = np.maximum(np.abs(centre - point) - half, 0.0)
            if np.linalg.norm(outside) < radius:
                return False
        lift = (sunk + _GAP + 1e-6) * face.frame.rotation[:, 2]  # off its support
        low = lower + lift - _GAP
        high = upper + lift + _GAP
        lows = np.array([other for other, _ in self.boxes])
        highs = np.array([other for _, other in self.boxes])
        return not ((low < highs) & (high > lows)).all(axis=1).any()


def _find_tops(shape: pin.GeometryObject) -> Iterator[_Face]:
    """Yield the upper face of a box if objects can rest on it."""
    half = np.asarray(shape.geometry.halfSide, float)
    rotation = shape.placement.rotation
    axis = int(np.argmax(np.abs(rotation[2])))
    if abs(rotation[2, axis]) < _VERTICAL or axis != 2:
        return
    top = shape.placement.translation + np.array([0.0, 0.0, half[2]])
    if _MIN_TOP <= top[2] <= _MAX_TOP and 2.0 * half[:2].min() >= _MIN_SIDE:
        yaw = math.atan2(rotation[1, 0], rotation[0, 0])
        yield _Face(pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, yaw), top), half[:2])


def _find_sides(shape: pin.GeometryObject, arena: Sequence[float]) -> Iterator[_Face]:
    """Yield those of the two large faces of a wall that are within the arena."""
    half = np.asarray(shape.geometry.halfSide, float)
    rotation = shape.placement.rotation
    x_min, x_max, y_min, y_max = arena
    thin = int(np.argmin(half[:2]))
    is_thin = 2.0 * half[thin] <= _MAX_THICKNESS
    is_high = 2.0 * half[2] >= _MIN_HEIGHT
    is_upright = abs(rotation[2, 2]) >= _VERTICAL
    if not (is_thin and is_high and is_upright):
        return
    up = np.array([0.0, 0.0, 1.0])
    for side in (-1.0, 1.0):
        out = side * rotation[:, thin]
        middle = shape.placement.translation + half[thin] * out
        x, y, _ = middle + 0.1 * out
        if x_min <= x <= x_max and y_min <= y <= y_max:
            face_rotation = np.column_stack([np.cross(up, out), up, out])
            yield _Face(pin.SE3(face_rotation, middle), np.array([half[1 - thin], half[2]]))


def _sample_object(rng: np.random.Generator) -> tuple[dict[str, Any], Floats, float]:
    """Return a random object's shape, its size with z up [m], and its depth in the surface, 0."""
    kind = int(rng.integers(4))
    u, v, w = rng.random(3).tolist()
    if kind >= 2:  # a book or a box
        size = [round(0.03 + 0.15 * u, 3), round(0.1 + 0.12 * v, 3), round(0.08 + 0.2 * w, 3)]
        return {"type": "box", "size": size}, np.array(size), 0.0
    if kind == 0:  # a bottle or a glass
        radius = round(0.025 + 0.025 * u, 3)
        length = round(0.1 + 0.2 * v, 3)
    else:  # a plate or a bowl
        radius = round(0.06 + 0.07 * u, 3)
        length = round(0.02 + 0.06 * v, 3)
    extent = np.array([2 * radius, 2 * radius, length])
    return {"type": "cylinder", "radius": radius, "length": length}, extent, 0.0


def _sample_picture(rng: np.random.Generator) -> tuple[dict[str, Any], Floats, float]:
    """Return a picture's box, its size with z normal to the wall, and its depth in the wall [m]."""
    width, height = rng.uniform(0.15, 0.6, 2).tolist()
    size = [round(width, 3), round(height, 3), 0.025]
    return {"type": "box", "size": size}, np.array(size), _SUNK
