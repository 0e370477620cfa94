"""Builds the parts of rooms as entries of a scene: walls, tables, shelves, boxes and fixtures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vkc_pin.procedural.rooms.fixtures import Fixture
from vkc_pin.procedural.rooms.footprints import Floor, Frame, Rectangle

WALL = 0.1  # [m] thickness
AIR = 0.02  # [m] between a wall and the parts against it
PLATE, LEG, BOARD = 0.03, 0.06, 0.02  # [m] thicknesses
BEFORE_TABLE = 1.5  # [m] depth of the free floor on one side of a table
_MIN_HALF_WIDTH = 0.75  # [m] of the free floor in front of a table, for a robot to turn
_ON = 0.001  # [m] between a free object and its table

CARRIED = {"cup": 0.0, "ball": 0.035}
"""Types of free objects for tables → height of their frame above the table [m]."""


@dataclass(frozen=True)
class Part:
    """A part of a room.

    Attributes:
        name: Its name in the scene, or the prefix of its obstacles' names.
        frame: Its frame; x points from the user's side into the part.
        footprint: Occupied floor.
        obstacles, objects: Its entries in a scene's description.
        clear_floor: Floor in front of it that stays free, if any.
        standing_place: Place in front of it where a robot can stand and turn, world frame [m].
        size: Its size along the frame's x and y, and its height [m].
        side: Side of the wall that contains it, for doors: 0 east, 1 north, 2 west, 3 south.
    """

    name: str
    frame: Frame
    footprint: Rectangle
    obstacles: tuple[dict[str, Any], ...] = ()
    objects: tuple[dict[str, Any], ...] = ()
    clear_floor: Rectangle | None = None
    standing_place: tuple[float, float] | None = None
    size: tuple[float, float, float] = (0.0, 0.0, 0.0)
    side: int | None = None


def make_box(name: str, frame: Frame, size: Sequence[float], colour: str) -> Part:
    """Return a box on the floor, centred at the frame's origin."""
    footprint = Rectangle(frame.x, frame.y, size[0], size[1], frame.yaw)
    return Part(
        name,
        frame,
        footprint,
        (_make_box_entry(name, frame, (0.0, 0.0), (0.0, size[2]), size[:2], colour),),
    )


def make_table(name: str, frame: Frame, size: tuple[float, float, float]) -> Part:
    """Return a table with a plate and four legs, centred at the frame's origin.

    The floor in front of its side at −x stays free.

    Args:
        name: Its name.
        frame: Its frame.
        size: Depth along x, width along y, height [m].
    """
    depth, width, height = size
    items = [
        _make_box_entry(
            f"{name}_top", frame, (0.0, 0.0), (height - PLATE, height), (depth, width), "oak"
        )
    ]
    for k, (x, y) in enumerate(((-1, -1), (-1, 1), (1, -1), (1, 1)), start=1):
        at = (x * (depth - LEG) / 2.0, y * (width - LEG) / 2.0)
        items.append(
            _make_box_entry(
                f"{name}_leg_{k}", frame, at, (0.0, height - PLATE), (LEG, LEG), "walnut"
            )
        )
    half, side = depth / 2.0, max(width / 2.0, _MIN_HALF_WIDTH)
    clear_floor = frame.make_rectangle((-half - BEFORE_TABLE, -half), (-side, side))
    standing_place = frame.transform_point(-half - BEFORE_TABLE / 2.0, 0.0)
    footprint = Rectangle(frame.x, frame.y, depth, width, frame.yaw)
    return Part(
        name,
        frame,
        footprint,
        tuple(items),
        clear_floor=clear_floor,
        standing_place=standing_place,
        size=size,
    )


def make_shelf(name: str, frame: Frame, size: tuple[float, float, float], boards: int) -> Part:
    """Return an open shelf with two sides, a back and boards, its back against a wall."""
    depth, width, height = size
    middle = -AIR - depth / 2.0
    back = _make_box_entry(
        f"{name}_back", frame, (-AIR - BOARD / 2.0, 0.0), (0.0, height), (BOARD, width), "walnut"
    )
    items = [back]
    for k, y in enumerate((-1, 1), start=1):
        at = (middle - BOARD / 2.0, y * (width - BOARD) / 2.0)
        items.append(
            _make_box_entry(
                f"{name}_side_{k}", frame, at, (0.0, height), (depth - BOARD, BOARD), "walnut"
            )
        )
    for k, low in enumerate(np.linspace(0.06, height - BOARD, boards).tolist(), start=1):
        inside = (depth - BOARD, width - 2.0 * BOARD)
        items.append(
            _make_box_entry(
                f"{name}_board_{k}",
                frame,
                (middle - BOARD / 2.0, 0.0),
                (low, low + BOARD),
                inside,
                "oak",
            )
        )
    footprint = frame.make_rectangle((-AIR - depth, -AIR), (-width / 2.0, width / 2.0))
    return Part(name, frame, footprint, tuple(items), size=size)


def make_openable(
    name: str, own: Fixture, floor: Floor, side: int, along: float, front: float
) -> Part:
    """Return an object that can be opened: in a wall, against it, or on a counter against it.

    The floor in front of it stays free.
    """
    low, high, counter = own.low, own.high, own.counter
    middle = (low[1] + high[1]) / 2.0
    wall = floor.make_wall_frame(side, along - middle)
    edge = -AIR - counter.size[0] if counter else 0.0  # of the counter, along the wall's frame
    offset = WALL / 2.0 if own.in_wall else edge + counter.setback if counter else -AIR - high[0]
    frame = Frame(*wall.transform_point(offset, 0.0), wall.yaw)
    sides, face = (low[1], high[1]), -WALL / 2.0 if own.in_wall else own.face
    footprint, items, up = frame.make_rectangle((low[0], high[0]), sides), [], own.lift
    if counter:
        depth, width, height = counter.size
        sides = (middle - width / 2.0, middle + width / 2.0)
        face = -counter.setback
        up = height + own.lift
        footprint = frame.make_rectangle((face, face + depth), sides)
        centre = (face + depth / 2.0, middle)
        items = [
            _make_box_entry(
                f"{name}_counter", frame, centre, (0.0, height - PLATE), (depth, width), "cream"
            ),
            _make_box_entry(
                f"{name}_worktop", frame, centre, (height - PLATE, height), (depth, width), "oak"
            ),
        ]
    y_range = (low[1] - own.beside, high[1] + own.beside)
    clear_floor = frame.make_rectangle((face - front, face), y_range)
    entry = {
        "name": name,
        "type": own.type,
        "position": [frame.x, frame.y, round(up, 4)],
        "yaw": frame.yaw,
    }
    standing_place = frame.transform_point(face - front / 2.0, middle)
    size = (float(high[0] - low[0]), float(high[1] - low[1]), float(high[2]))
    return Part(
        name,
        frame,
        footprint,
        tuple(items),
        (entry,),
        clear_floor,
        standing_place,
        size,
        side if own.in_wall else None,
    )


def make_carried_object(name: str, kind: str, on: Part, x: float, y: float) -> Part:
    """Return a free object on a table."""
    place = on.frame.transform_point(x, y)
    entry = {
        "name": name,
        "type": kind,
        "position": [*place, round(on.size[2] + CARRIED[kind] + _ON, 3)],
    }
    return Part(name, Frame(*place, 0.0), on.footprint, (), (entry,))


def make_walls(floor: Floor, height: float, parts: Sequence[Part]) -> list[dict[str, Any]]:
    """Return the walls around a floor as entries of a scene, with openings for doors.

    Args:
        floor: Floor.
        height: Height of the walls [m].
        parts: Parts of the room, of which the doors have a `side`.
    """
    items = []
    for side, name in enumerate(("east", "north", "west", "south")):
        half, frame = floor.compute_half_length(side), floor.make_wall_frame(side, 0.0)
        end = half + WALL if side % 2 else half  # the walls north and south include the corners
        begin, own = -end, f"wall_{name}"
        centres = {
            part.name: _project_along(frame, part.footprint) for part in parts if part.side == side
        }
        doors = sorted(
            (part for part in parts if part.side == side), key=lambda part: centres[part.name]
        )
        for k, door in enumerate(doors, start=1):
            middle, width = centres[door.name], door.size[1]
            low, high, top = middle - width / 2.0, middle + width / 2.0, door.size[2]
            items.append(_make_wall(f"{own}_{k}", frame, (begin, low), (0.0, height)))
            if top < height:
                items.append(
                    _make_wall(f"{own}_above_{door.name}", frame, (low, high), (top, height))
                )
            begin = high
        items.append(
            _make_wall(
                f"{own}_{len(doors) + 1}" if doors else own, frame, (begin, end), (0.0, height)
            )
        )
    return items


def _make_wall(
    name: str, frame: Frame, along: tuple[float, float], z: tuple[float, float]
) -> dict[str, Any]:
    return _make_box_entry(
        name, frame, (WALL / 2.0, sum(along) / 2.0), z, (WALL, along[1] - along[0]), "wall"
    )


def _project_along(frame: Frame, rectangle: Rectangle) -> float:
    """Return the position of a rectangle's centre along a frame's y [m]."""
    return float(
        -np.sin(frame.yaw) * (rectangle.x - frame.x) + np.cos(frame.yaw) * (rectangle.y - frame.y)
    )


def _make_box_entry(
    name: str,
    frame: Frame,
    at: tuple[float, float],
    z: tuple[float, float],
    size: Sequence[float],
    colour: str,
) -> dict[str, Any]:
    """Return a box as an entry of a scene, centred at a point of a frame."""
    edges = [round(float(edge), 3) for edge in (*size, z[1] - z[0])]
    position = [*frame.transform_point(*at), round((z[0] + z[1]) / 2.0, 4)]
    return {
        "name": name,
        "type": "box",
        "size": edges,
        "position": position,
        "yaw": frame.yaw,
        "colour": colour,
    }
