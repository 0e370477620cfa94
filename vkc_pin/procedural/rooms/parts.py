"""Builds the parts of rooms as entries of a scene: walls, tables, shelves, boxes and fixtures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vkc_pin.procedural.rooms.fixtures import Fixture
from vkc_pin.procedural.rooms.footprints import Floor, Frame, Rectangle

# [m] thickness
WALL = 0.1
# [m] between a wall and the parts against it
AIR = 0.02
# [m] thicknesses
PLATE = 0.03
LEG = 0.06
BOARD = 0.02
# [m] depth of the free floor on one side of a table
BEFORE_TABLE = 1.5
# [m] of the free floor in front of a table, for a robot to turn
_MIN_HALF_WIDTH = 0.75
# [m] between a free object and its table
_ON = 0.001

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
    entry = _make_box_entry(name, frame, (0.0, 0.0), (0.0, size[2]), size[:2], colour)
    return Part(name, frame, footprint, (entry,))


def make_table(name: str, frame: Frame, size: tuple[float, float, float]) -> Part:
    """Return a table with a plate and four legs, centred at the frame's origin.

    The floor in front of its side at −x stays free.

    Args:
        name: Its name.
        frame: Its frame.
        size: Depth along x, width along y, height [m].
    """
    depth, width, height = size
    below = height - PLATE
    top = _make_box_entry(f"{name}_top", frame, (0.0, 0.0), (below, height), (depth, width), "oak")
    items = [top]
    for k, (x, y) in enumerate(((-1, -1), (-1, 1), (1, -1), (1, 1)), start=1):
        at = (x * (depth - LEG) / 2.0, y * (width - LEG) / 2.0)
        leg = _make_box_entry(f"{name}_leg_{k}", frame, at, (0.0, below), (LEG, LEG), "walnut")
        items.append(leg)
    front = -depth / 2.0
    side = max(width / 2.0, _MIN_HALF_WIDTH)
    clear_floor = frame.make_rectangle((front - BEFORE_TABLE, front), (-side, side))
    standing_place = frame.transform_point(front - BEFORE_TABLE / 2.0, 0.0)
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
    full_height = (0.0, height)
    behind = -AIR - BOARD / 2.0
    middle = -AIR - depth / 2.0 - BOARD / 2.0  # of sides and boards, which are before the back
    back = _make_box_entry(
        f"{name}_back", frame, (behind, 0.0), full_height, (BOARD, width), "walnut"
    )
    items = [back]
    for k, y in enumerate((-1, 1), start=1):
        at = (middle, y * (width - BOARD) / 2.0)
        extent = (depth - BOARD, BOARD)
        side = _make_box_entry(f"{name}_side_{k}", frame, at, full_height, extent, "walnut")
        items.append(side)
    inside = (depth - BOARD, width - 2.0 * BOARD)
    for k, low in enumerate(np.linspace(0.06, height - BOARD, boards).tolist(), start=1):
        z = (low, low + BOARD)
        items.append(_make_box_entry(f"{name}_board_{k}", frame, (middle, 0.0), z, inside, "oak"))
    footprint = frame.make_rectangle((-AIR - depth, -AIR), (-width / 2.0, width / 2.0))
    return Part(name, frame, footprint, tuple(items), size=size)


def make_openable(
    name: str, own: Fixture, floor: Floor, side: int, along: float, front: float
) -> Part:
    """Return an object that can be opened: in a wall, against it, or on a counter against it.

    The floor in front of it stays free.
    """
    low = own.low
    high = own.high
    counter = own.counter
    middle = (low[1] + high[1]) / 2.0
    wall = floor.make_wall_frame(side, along - middle)
    # x of the object's frame in the wall's frame, which points out of the room
    if own.in_wall:
        offset = WALL / 2.0
    elif counter:
        offset = -AIR - counter.size[0] + counter.setback
    else:
        offset = -AIR - high[0]
    frame = Frame(*wall.transform_point(offset, 0.0), wall.yaw)
    items: list[dict[str, Any]] = []
    if counter:
        depth, width, height = counter.size
        face = -counter.setback
        z = height + own.lift
        footprint = frame.make_rectangle(
            (face, face + depth), (middle - width / 2.0, middle + width / 2.0)
        )
        centre = (face + depth / 2.0, middle)
        below = (0.0, height - PLATE)
        plate = (height - PLATE, height)
        items = [
            _make_box_entry(f"{name}_counter", frame, centre, below, (depth, width), "cream"),
            _make_box_entry(f"{name}_worktop", frame, centre, plate, (depth, width), "oak"),
        ]
    else:
        face = -WALL / 2.0 if own.in_wall else own.face
        z = own.lift
        footprint = frame.make_rectangle((low[0], high[0]), (low[1], high[1]))
    y_range = (low[1] - own.beside, high[1] + own.beside)
    clear_floor = frame.make_rectangle((face - front, face), y_range)
    entry = {
        "name": name,
        "type": own.type,
        "position": [frame.x, frame.y, round(z, 4)],
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
    world_x, world_y = on.frame.transform_point(x, y)
    z = round(on.size[2] + CARRIED[kind] + _ON, 3)
    entry = {"name": name, "type": kind, "position": [world_x, world_y, z]}
    return Part(name, Frame(world_x, world_y, 0.0), on.footprint, (), (entry,))


def make_walls(floor: Floor, height: float, parts: Sequence[Part]) -> list[dict[str, Any]]:
    """Return the walls around a floor as entries of a scene, with openings for doors.

    Args:
        floor: Floor.
        height: Height of the walls [m].
        parts: Parts of the room, of which the doors have a `side`.
    """
    items: list[dict[str, Any]] = []
    for side, name in enumerate(("east", "north", "west", "south")):
        doors = [part for part in parts if part.side == side]
        items += _make_wall_with_doors(f"wall_{name}", floor, side, height, doors)
    return items


def _make_wall_with_doors(
    name: str, floor: Floor, side: int, height: float, doors: Sequence[Part]
) -> list[dict[str, Any]]:
    """Return the pieces of a wall: beside its doors, and above them."""
    frame = floor.make_wall_frame(side, 0.0)
    end = floor.compute_half_length(side)
    if side % 2:
        end += WALL  # the walls north and south include the corners
    full_height = (0.0, height)
    centres = {door.name: _project_along(frame, door.footprint) for door in doors}
    items: list[dict[str, Any]] = []
    begin = -end
    for k, door in enumerate(sorted(doors, key=lambda door: centres[door.name]), start=1):
        middle = centres[door.name]
        _, width, top = door.size
        low = middle - width / 2.0
        high = middle + width / 2.0
        items.append(_make_wall(f"{name}_{k}", frame, (begin, low), full_height))
        if top < height:
            items.append(_make_wall(f"{name}_above_{door.name}", frame, (low, high), (top, height)))
        begin = high
    last = f"{name}_{len(doors) + 1}" if doors else name
    items.append(_make_wall(last, frame, (begin, end), full_height))
    return items


def _make_wall(
    name: str, frame: Frame, along: tuple[float, float], z: tuple[float, float]
) -> dict[str, Any]:
    """Return a piece of a wall as an entry of a scene."""
    begin, end = along
    centre = (WALL / 2.0, (begin + end) / 2.0)
    return _make_box_entry(name, frame, centre, z, (WALL, end - begin), "wall")


def _project_along(frame: Frame, rectangle: Rectangle) -> float:
    """Return the position of a rectangle's centre along a frame's y [m].

    With the frame's heading θ, y points along (−sin θ, cos θ).
    """
    dx = rectangle.x - frame.x
    dy = rectangle.y - frame.y
    return float(-np.sin(frame.yaw) * dx + np.cos(frame.yaw) * dy)


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
