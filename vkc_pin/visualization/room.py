"""Prepares obstacles for drawing, with walls that are transparent from outside the room."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats
from vkc_pin.visualization.threejs import Solid, make_box, shade, to_solid
from vkc_pin.world.files.meshes import load_parts
from vkc_pin.world.models.shapes import compute_world_box
from vkc_pin.world.scene.scene import Scene

# An upright box at most this thick that reaches at least this high is a wall [m].
_THIN = 0.25
_HIGH = 2.0
_BEYOND = 0.35  # a wall with more of the arena behind it is a partition [m]
_VEIL, _DIVIDER = 0.07, 0.32  # opacities
_FLOOR_COLOUR = (0.90, 0.89, 0.87)
_DETAIL = 1e-3  # [m] of meshes


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
        for shape in scene.obstacle_visual:
            (self._walls if is_wall(shape) else self._furniture).append(shape)

    def make_parts(self) -> list[Part]:
        """Return the meshes to draw."""
        parts = []
        if self.scene.floor:
            x_min, x_max, y_min, y_max = self.scene.arena
            floor = make_box(np.array([x_min, y_min, -0.03]), np.array([x_max, y_max, 0.0]))
            parts.append(Part("floor", floor, _FLOOR_COLOUR, shadow=False))
        for shape in self._furniture:
            drawn = load_drawn_parts(shape)
            for k, (solid, colour) in enumerate(drawn):
                name = f"{shape.name}/{k}" if len(drawn) > 1 else str(shape.name)
                opacity = colour[3] if len(colour) > 3 else 1.0
                parts.append(
                    Part(
                        name,
                        solid.transform(shape.placement),
                        colour,
                        opacity,
                        shadow=opacity >= 1.0,
                    )
                )
        for shape in self._walls:
            parts += self._make_wall_parts(shape)
        return parts

    def make_lines(self) -> list[tuple[str, Floats, float]]:
        """Return name, segments, shape (2·k, 3) [m], and brightness of grid and wall edges."""
        drawn = []
        if self.scene.floor:
            x_min, x_max, y_min, y_max = self.scene.arena
            xs, ys = (
                np.arange(np.ceil(low / 0.5) * 0.5, high, 0.5)
                for low, high in ((x_min, x_max), (y_min, y_max))
            )
            ends = [[(x, y_min), (x, y_max)] for x in xs] + [[(x_min, y), (x_max, y)] for y in ys]
            flat = np.array(ends, float).reshape(-1, 2)
            drawn.append(("grid", np.column_stack([flat, np.full(len(flat), 0.002)]), 0.78))
        edges = [
            shape.placement.act(corner) for shape in self._walls for corner in _find_edges(shape)
        ]
        if edges:
            drawn.append(("wall_edges", np.array(edges), 0.55))
        return drawn

    def find_obstructions(self) -> list[tuple[Floats, Floats, float]]:
        """Return boxes of obstacles: lower and upper corner, shape (3,) each [m], and opacity."""
        opacities = [
            *((wall, 0.6 if self._is_divider(wall) else 0.0) for wall in self._walls),
            *((one, 1.0) for one in self._furniture),
        ]
        return [
            (*compute_world_box(shape.geometry, shape.placement), opacity)
            for shape, opacity in opacities
        ]

    def _find_inside(self, shape: pin.GeometryObject) -> tuple[int, float]:
        """Return a wall's thin axis in its frame, and the sign of its side facing the centre."""
        axis = int(np.argmin(np.asarray(shape.geometry.halfSide)[:2]))
        towards = shape.placement.actInv(self.centre)[axis]
        return axis, 1.0 if towards > 0.0 else -1.0

    def _is_divider(self, shape: pin.GeometryObject) -> bool:
        axis, sign = self._find_inside(shape)
        behind = np.zeros(3)
        behind[axis] = -sign * (float(shape.geometry.halfSide[axis]) + _BEYOND)
        x, y, _ = shape.placement.act(behind)
        x_min, x_max, y_min, y_max = self.scene.arena
        return bool(x_min < x < x_max and y_min < y < y_max)

    def _make_wall_parts(self, shape: pin.GeometryObject) -> list[Part]:
        half, colour = np.asarray(shape.geometry.halfSide), tuple(map(float, shape.meshColor))

        def make_part(name: str, opacity: float, sides: tuple[int, ...]) -> Part:
            solid = make_box(-half, half, sides).transform(shape.placement)
            return Part(
                f"walls/{shape.name}/{name}", solid, colour, opacity, shadow=False, one_sided=True
            )

        if self._is_divider(shape):
            return [make_part("sides", _DIVIDER, (0, 1, 2, 3, 5))]
        axis, sign = self._find_inside(shape)
        inside = 2 * axis + (sign > 0)
        return [
            make_part("inside", 1.0, (inside,)),
            make_part("outside", _VEIL, tuple(s for s in range(4) if s != inside)),
        ]


def load_drawn_parts(shape: pin.GeometryObject) -> list[tuple[Solid, tuple[float, ...]]]:
    """Load meshes, in the shape's frame, and colours of a shape, from its file if available."""
    colour = tuple(float(c) for c in shape.meshColor)
    if shape.meshPath and Path(shape.meshPath).is_file():
        parts = load_parts(shape.meshPath, np.asarray(shape.meshScale).ravel(), detail=_DETAIL)
        own = bool(shape.overrideMaterial)
        return [
            (shade(part.vertices, part.faces), colour if own else part.colour or colour)
            for part in parts
        ]
    return [(to_solid(shape.geometry), colour)]


def is_wall(shape: pin.GeometryObject) -> bool:
    """Return whether an obstacle is a wall: an upright box, thin and high."""
    if not isinstance(shape.geometry, coal.Box):
        return False
    half = np.asarray(shape.geometry.halfSide)
    top = shape.placement.translation[2] + half[2]
    upright = abs(shape.placement.rotation[2, 2]) > 0.999
    return bool(
        upright
        and 2.0 * half[:2].min() <= _THIN
        and top >= _HIGH
        and half[:2].max() > 2.0 * half[:2].min()
    )


def _find_edges(shape: pin.GeometryObject) -> Floats:
    """Return the twelve edges of a box, shape (24, 3) [m]."""
    half = np.asarray(shape.geometry.halfSide)
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    pairs = [(a, b) for a in range(8) for b in range(a) if np.abs(signs[a] - signs[b]).sum() == 2]
    return np.asarray((signs * half)[np.array(pairs).ravel()])
