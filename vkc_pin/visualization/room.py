"""Prepares obstacles for drawing, with walls that are transparent from outside the room."""

from __future__ import annotations

import itertools
from dataclasses import KW_ONLY, dataclass
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats
from vkc_pin.visualization.threejs import Solid, make_box, shade, to_solid
from vkc_pin.world.collision.point_cloud import PointCloud, select_for_drawing
from vkc_pin.world.files.meshes import load_parts
from vkc_pin.world.models.shapes import compute_world_box
from vkc_pin.world.scene.scene import Scene

# An upright box at most this thick that reaches at least this high is a wall [m].
_THIN = 0.25
_HIGH = 2.0
# [m] A wall with more of the arena behind it is a partition.
_BEYOND = 0.35
# opacities of a wall's outside, and of partitions
_OUTSIDE = 0.07
_DIVIDER = 0.32
_FLOOR_COLOUR = (0.90, 0.89, 0.87)
# [m] between lines of the floor's grid, and their height above it
_GRID_STEP = 0.5
_GRID_HEIGHT = 0.002
# [m] of meshes
_DETAIL = 1e-3
_MAX_DRAWN_POINTS = 100_000  # 2.4 MB in a page
_CLOUD_OPACITY = 0.3  # of a block of measured points, between which one sees


@dataclass(frozen=True, eq=False)
class Part:
    """A static mesh to draw: name, triangles in the world frame, colour and opacity.

    Attributes:
        shadow: Whether it casts a shadow.
        one_sided: Whether it is visible from its front only.
    """

    name: str
    solid: Solid
    colour: tuple[float, ...]
    opacity: float = 1.0
    _: KW_ONLY
    shadow: bool = True
    one_sided: bool = False


class Room:
    """The obstacles of a scene and its floor.

    Attributes:
        centre: Centre of the arena on the floor, shape (3,) [m].
        reach: Half of the arena's diagonal [m].
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        x_min, x_max, y_min, y_max = scene.arena
        self.centre = np.array([(x_min + x_max) / 2.0, (y_min + y_max) / 2.0, 0.0])
        self.reach = float(np.hypot(x_max - x_min, y_max - y_min)) / 2.0
        self._walls: list[pin.GeometryObject] = []
        self._furniture: list[pin.GeometryObject] = []
        self._clouds: dict[str, list[pin.GeometryObject]] = {}
        labels = scene.obstacle_visual_labels
        for shape, label in zip(scene.obstacle_visual, labels, strict=True):
            if isinstance(shape.geometry, PointCloud):
                self._clouds.setdefault(label, []).append(shape)
            elif is_wall(shape):
                self._walls.append(shape)
            else:
                self._furniture.append(shape)

    def make_parts(self) -> list[Part]:
        """Return the meshes to draw."""
        parts: list[Part] = []
        if self.scene.floor:
            x_min, x_max, y_min, y_max = self.scene.arena
            floor = make_box(np.array([x_min, y_min, -0.03]), np.array([x_max, y_max, 0.0]))
            parts.append(Part("floor", floor, _FLOOR_COLOUR, shadow=False))
        for shape in self._furniture:
            drawn = load_drawn_parts(shape)
            for k, (solid, colour) in enumerate(drawn):
                name = f"{shape.name}/{k}" if len(drawn) > 1 else str(shape.name)
                opacity = colour[3] if len(colour) > 3 else 1.0
                placed = solid.transform(shape.placement)
                parts.append(Part(name, placed, colour, opacity, shadow=opacity >= 1.0))
        for shape in self._walls:
            parts += self._make_wall_parts(shape)
        return parts

    def make_clouds(self) -> list[tuple[str, Floats, float, tuple[float, ...]]]:
        """Return name, points, shape (n, 3) [m], radius [m] and colour of measured points.

        Of more than 100 000 points, every k-th is drawn.
        """
        clouds = []
        for label, shapes in self._clouds.items():
            placed = [shape.geometry.place(shape.placement) for shape in shapes]
            points = select_for_drawing(np.concatenate(placed), _MAX_DRAWN_POINTS)
            colour = tuple(float(value) for value in shapes[0].meshColor[:3])
            clouds.append((label, points, float(shapes[0].geometry.radius), colour))
        return clouds

    def make_lines(self) -> list[tuple[str, Floats, float]]:
        """Return name, segments, shape (2·k, 3) [m], and brightness of grid and wall edges."""
        lines: list[tuple[str, Floats, float]] = []
        if self.scene.floor:
            lines.append(("grid", self._make_grid(), 0.78))
        edges: list[Floats] = []
        for shape in self._walls:
            edges += [shape.placement.act(corner) for corner in _find_edges(shape)]
        if edges:
            lines.append(("wall_edges", np.array(edges), 0.55))
        return lines

    def _make_grid(self) -> Floats:
        """Return the segments of the floor's grid, shape (2·k, 3) [m]."""
        x_min, x_max, y_min, y_max = self.scene.arena
        ends: list[tuple[float, float]] = []
        for x in np.arange(np.ceil(x_min / _GRID_STEP) * _GRID_STEP, x_max, _GRID_STEP):
            ends += [(x, y_min), (x, y_max)]
        for y in np.arange(np.ceil(y_min / _GRID_STEP) * _GRID_STEP, y_max, _GRID_STEP):
            ends += [(x_min, y), (x_max, y)]
        flat = np.array(ends, float).reshape(-1, 2)
        return np.column_stack([flat, np.full(len(flat), _GRID_HEIGHT)])

    def find_obstructions(self) -> list[tuple[Floats, Floats, float]]:
        """Return boxes of obstacles: lower and upper corner, shape (3,) each [m], and opacity."""
        boxes: list[tuple[Floats, Floats, float]] = []
        for wall in self._walls:
            lower, upper = compute_world_box(wall.geometry, wall.placement)
            boxes.append((lower, upper, 0.6 if self._is_divider(wall) else 0.0))
        for shape in self._furniture:
            lower, upper = compute_world_box(shape.geometry, shape.placement)
            boxes.append((lower, upper, 1.0))
        for shapes in self._clouds.values():
            for shape in shapes:
                lower, upper = compute_world_box(shape.geometry, shape.placement)
                boxes.append((lower, upper, _CLOUD_OPACITY))
        return boxes

    def _find_inside(self, shape: pin.GeometryObject) -> tuple[int, float]:
        """Return a wall's thin axis in its frame, and the sign of its side facing the centre."""
        axis = int(np.argmin(np.asarray(shape.geometry.halfSide)[:2]))
        towards = shape.placement.actInv(self.centre)[axis]
        return axis, 1.0 if towards > 0.0 else -1.0

    def _is_divider(self, shape: pin.GeometryObject) -> bool:
        """Return whether a wall divides the arena."""
        axis, sign = self._find_inside(shape)
        behind = np.zeros(3)
        behind[axis] = -sign * (float(shape.geometry.halfSide[axis]) + _BEYOND)
        x, y, _ = shape.placement.act(behind)
        x_min, x_max, y_min, y_max = self.scene.arena
        return bool(x_min < x < x_max and y_min < y < y_max)

    def _make_wall_parts(self, shape: pin.GeometryObject) -> list[Part]:
        """Return the sides of a wall; see `make_box` for their numbers."""
        half = np.asarray(shape.geometry.halfSide)
        colour = tuple(float(value) for value in shape.meshColor)

        def make_part(name: str, opacity: float, sides: tuple[int, ...]) -> Part:
            solid = make_box(-half, half, sides).transform(shape.placement)
            path = f"walls/{shape.name}/{name}"
            return Part(path, solid, colour, opacity, shadow=False, one_sided=True)

        if self._is_divider(shape):
            return [make_part("sides", _DIVIDER, (0, 1, 2, 3, 5))]
        axis, sign = self._find_inside(shape)
        inside = 2 * axis + (1 if sign > 0 else 0)
        outside = tuple(side for side in range(4) if side != inside)
        return [make_part("inside", 1.0, (inside,)), make_part("outside", _OUTSIDE, outside)]


def load_drawn_parts(shape: pin.GeometryObject) -> list[tuple[Solid, tuple[float, ...]]]:
    """Load meshes, in the shape's frame, and colours of a shape, from its file if available."""
    colour = tuple(float(value) for value in shape.meshColor)
    if not shape.meshPath or not Path(shape.meshPath).is_file():
        return [(to_solid(shape.geometry), colour)]
    drawn: list[tuple[Solid, tuple[float, ...]]] = []
    for part in load_parts(shape.meshPath, np.asarray(shape.meshScale).ravel(), detail=_DETAIL):
        own_colour = None if shape.overrideMaterial else part.colour
        drawn.append((shade(part.vertices, part.faces), own_colour or colour))
    return drawn


def is_wall(shape: pin.GeometryObject) -> bool:
    """Return whether an obstacle is a wall: an upright box, thin and high."""
    if not isinstance(shape.geometry, coal.Box):
        return False
    half = np.asarray(shape.geometry.halfSide)
    top = shape.placement.translation[2] + half[2]
    is_upright = abs(shape.placement.rotation[2, 2]) > 0.999
    is_thin = 2.0 * half[:2].min() <= _THIN
    is_long = half[:2].max() > 2.0 * half[:2].min()
    return bool(is_upright and is_thin and top >= _HIGH and is_long)


def _find_edges(shape: pin.GeometryObject) -> Floats:
    """Return the twelve edges of a box, shape (24, 3) [m]."""
    half = np.asarray(shape.geometry.halfSide)
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    ends: list[int] = []
    for a in range(8):
        for b in range(a):
            # The corners of an edge differ in one sign.
            if np.abs(signs[a] - signs[b]).sum() == 2:
                ends += [a, b]
    return np.asarray((signs * half)[ends])
