"""Generates random rooms as scenes, with furniture, objects to open and floor to reach them."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError, format_value
from vkc_pin.procedural.rooms import parts
from vkc_pin.procedural.rooms.fixtures import (
    OPENABLE,
    Fixture,
    list_openable_types,
    make_fixture,
    make_fixture_name,
)
from vkc_pin.procedural.rooms.footprints import Floor, Frame
from vkc_pin.procedural.rooms.parts import CARRIED, Part
from vkc_pin.utils.arguments import (
    check_choice,
    check_instance,
    check_integer,
    check_list,
    check_mapping,
    check_text,
    is_number,
)
from vkc_pin.world.files.resources import check_path, find_resource_folder
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.robot_file import load_robot
from vkc_pin.world.models.shapes import compute_world_box
from vkc_pin.world.scene.scene import START_CLEARANCE, Scene

# on one table
_MAX_CARRIED = 4
# places for one part
_MAX_TRIES = 60
# rooms that are started because a part of the one before did not fit
_MAX_ROOMS = 60
# places for the robot
_MAX_STARTS = 1000
# [m] around a turning robot: more than a plan's clearance and half a grid cell
_TURNING = 0.07
# pieces of furniture per square metre of floor at clutter 1
_DENSITY = 0.45
# fraction of tables that are against a wall
_AT_WALL = 0.6
# [m] of floor beyond a wall with a door
_BEYOND = 2.0
_COLOURS = ("teal", "terracotta", "blue", "cream", "orange", "grey", "green")
# [m] from the middle of a free object to the edges of its table
_EDGE = 0.1


@dataclass(frozen=True)
class RoomSettings:
    """Settings of random rooms. All fields are checked when an instance is created.

    Attributes:
        clutter: Amount of furniture, from 0, nothing but `tables`, to 1.
        objects: Types of objects that can be opened; None: one or two, at random, of `door`,
            `narrow_door`, `wide_door`, `drawer`, `low_drawer`, `refrigerator` and `cabinet`, which
            have fixed sizes. `random_door`, `random_oven` and others have other sizes in every
            room, see `random_object`. Objects can also be given by path, or as results of
            `random_object`: they stand on the floor with their front, -x, towards the room.
        tables: Minimum number of tables, each with a side at which a robot can stand.
        carried: Types of free objects, up to four of `cup` and `ball`, on the first table.
        width: Shortest and longest inner length of a wall [m].
        height: Height of the walls [m].
        front: Depth of the free floor in front of objects that can be opened [m].
        gap: Minimum distance between the parts of a room [m].
        robot: Name of the robot, or path of its file or folder.
    """

    clutter: float = 0.5
    objects: tuple[str | Mapping[str, Any], ...] | None = None
    tables: int = 1
    carried: tuple[str, ...] = ()
    width: tuple[float, float] = (4.0, 7.0)
    height: float = 2.4
    front: float = 1.8
    gap: float = 0.1
    robot: str = "husky_ur5e"

    def __post_init__(self) -> None:
        _check_range("clutter", self.clutter, 0.0, 1.0)
        _check_range("height", self.height, 2.1, 10.0)
        _check_range("front", self.front, 1.5, 3.0)
        _check_range("gap", self.gap, 0.02, 1.0)
        object.__setattr__(self, "width", _parse_width(self.width))
        object.__setattr__(self, "tables", check_integer(self.tables, "tables", low=0, high=10))
        if self.objects is not None:
            types: tuple[Any, ...] = check_list(self.objects, "objects", "a list of types")
            object.__setattr__(self, "objects", tuple(_parse_openable(kind) for kind in types))
        kinds: tuple[Any, ...] = check_list(self.carried, "carried", "a list of types")
        carried = [
            check_choice(kind, CARRIED, "object that is carried", "carried") for kind in kinds
        ]
        object.__setattr__(self, "carried", tuple(carried))
        object.__setattr__(self, "robot", _parse_robot(self.robot))
        if len(self.carried) > _MAX_CARRIED:
            raise InputError(
                "too many",
                field="carried",
                expected=f"at most {_MAX_CARRIED}",
                got=len(self.carried),
            )
        if self.carried and not self.tables:
            raise InputError(
                "there is no table for it",
                field="carried",
                expected="at least 1 table",
                got=self.tables,
            )


def _parse_width(width: Any) -> tuple[float, float]:
    """Return the shortest and longest length of a wall [m]."""
    expected = "two lengths of 4 to 20 m, the lower one first"
    if not isinstance(width, tuple | list) or len(width) != 2:
        raise InputError(
            "not an interval", field="width", expected=expected, got=format_value(width)
        )
    shortest, longest = width
    _check_range("width", shortest, 4.0, 20.0)
    _check_range("width", longest, 4.0, 20.0)
    if shortest > longest:
        raise InputError(
            "the interval is empty", field="width", expected=expected, got=format_value(width)
        )
    return float(shortest), float(longest)


def _is_path(value: Any, endings: tuple[str, ...]) -> bool:
    """Return whether an object or robot is given by the path of its file."""
    if isinstance(value, str):
        return value.endswith(endings) or "/" in value
    return isinstance(value, Path)


def _parse_openable(kind: Any) -> str | dict[str, Any]:
    """Return the type of an object that can be opened. Raises an error for an unknown name."""
    if isinstance(kind, Mapping):
        return check_mapping(kind, "objects")
    if _is_path(kind, (".yaml", ".yml")):
        return str(check_path(kind, "objects"))
    return check_choice(kind, list_openable_types(), "object that opens", "objects")


def _parse_robot(robot: Any) -> str:
    """Return a robot's name, or the absolute path of its file or folder.

    Rooms are saved without a folder that paths could be relative to.
    """
    if _is_path(robot, (".urdf", ".yaml", ".yml")):
        return str(check_path(robot, "robot").resolve())
    return check_text(robot, "robot", "a robot's name, or the path of its file")


def _check_range(name: str, value: Any, low: float, high: float) -> None:
    """Raise an error unless a setting is a number from `low` to `high`."""
    if not is_number(value) or not low <= value <= high:
        raise InputError(
            "out of range",
            field=name,
            expected=f"a number from {low:g} to {high:g}",
            got=format_value(value),
        )


@dataclass(frozen=True)
class Layout:
    """A room before it becomes a scene.

    Attributes:
        number: Number of the room.
        settings: Its settings.
        floor: Its floor.
        parts: Its parts; free objects come last.
        start: Start of the robot's base, shape (3,): x, y [m] and yaw [rad].
        radius: Radius of the disc in which the robot can turn with its arm at home [m].
    """

    number: int
    settings: RoomSettings
    floor: Floor
    parts: tuple[Part, ...]
    start: tuple[float, float, float]
    radius: float

    def find_part(self, name: str) -> Part:
        """Return the part of a name. Raises `UnknownNameError` if there is none."""
        known = {part.name: part for part in self.parts}
        if name not in known:
            raise UnknownNameError("part", name, known)
        return known[name]

    def make_scene(self) -> Scene:
        """Return the room as a scene called `room_<number>`."""
        # Distances of the sides from the centre; a door leads to floor beyond its wall.
        reach = [self.floor.compute_half_length(side + 1) for side in range(4)]
        obstacles = parts.make_walls(self.floor, self.settings.height, self.parts)
        objects: list[dict[str, Any]] = []
        for part in self.parts:
            if part.side is not None:
                reach[part.side] = self.floor.compute_half_length(part.side + 1) + _BEYOND
            obstacles += part.obstacles
            objects += part.objects
        east, north, west, south = reach
        document = {
            "name": f"room_{self.number}",
            "robot": self.settings.robot,
            "start": {"base": list(self.start)},
            "arena": {"x": [-west, east], "y": [-south, north]},
            "obstacles": obstacles,
            "objects": objects,
        }
        return Scene.from_document(document, find_resource_folder("scenes"))


def random_room(number: int, settings: RoomSettings | None = None, **changes: Any) -> Scene:
    """Return the random room of a number, with a robot in it, as a scene; it is reproducible.

    Tables, shelves and boxes stand on the floor, doors are in the walls, and drawers, cabinets and
    refrigerators are against them. Nothing overlaps. The floor is free in front of objects that can
    be opened and on one side of every table, and the robot gets there from its start with its arm
    at home. Whether tasks are feasible is not checked.

    Args:
        number: Number of the room, from 0.
        settings: Settings of rooms; None: `RoomSettings()`.
        changes: Fields of `RoomSettings` that differ, such as `clutter=0.8`.

    Raises:
        InputError: A number or a field is out of range, or the parts do not fit into a room of this
            size.
        UnknownNameError: There is no such field, or no such type of object.
    """
    return sample_layout(number, settings, **changes).make_scene()


def sample_layout(number: int, settings: RoomSettings | None = None, **changes: Any) -> Layout:
    """Return the layout of a random room; see `random_room`."""
    number = check_integer(number, "number", low=0)
    known = [item.name for item in dataclasses.fields(RoomSettings)]
    for name in changes:
        if name not in known:
            raise UnknownNameError("field of RoomSettings", name, known, field=name)
    if settings is None:
        settings = RoomSettings()
    check_instance(settings, RoomSettings, "settings")
    chosen = dataclasses.replace(settings, **changes)
    rng = np.random.default_rng([1, number])
    radius = _compute_turning_radius(load_robot(chosen.robot))
    named = None if chosen.objects is None else _name_fixtures(chosen.objects, number)
    for _ in range(_MAX_ROOMS):
        found = _Room(chosen, rng, radius).furnish(named)
        if found is not None:
            floor, standing, start = found
            return Layout(number, chosen, floor, standing, start, radius)
    raise InputError(
        f"no room in {_MAX_ROOMS} could hold all parts",
        field="clutter",
        expected="less clutter, fewer objects or tables, wider rooms, "
        "or a robot with a smaller home pose",
        got=f"{chosen.clutter:g}, and a robot with a turning radius of {radius:.2f} m",
    )


def _name_fixtures(
    kinds: Sequence[str | Mapping[str, Any]], number: int
) -> list[tuple[str, Fixture]]:
    """Return the objects to open, with their names in the room of a number."""
    names = _number_equal_names([make_fixture_name(kind) for kind in kinds])
    fixtures = [make_fixture(kind, 100 * number + k) for k, kind in enumerate(kinds)]
    return list(zip(names, fixtures, strict=True))


def _number_equal_names(names: Sequence[str]) -> list[str]:
    """Return names that differ: "door_1" and "door_2" for two doors."""
    numbered: list[str] = []
    for k, name in enumerate(names):
        if names.count(name) == 1:
            numbered.append(name)
        else:
            numbered.append(f"{name}_{names[: k + 1].count(name)}")
    return numbered


class _Room:
    """A room that is being furnished, by rejection sampling of the places of its parts."""

    def __init__(self, settings: RoomSettings, rng: np.random.Generator, radius: float) -> None:
        self.settings = settings
        self.rng = rng
        self.radius = radius
        width, depth = rng.uniform(*settings.width, 2).tolist()
        self.floor = Floor(round(width, 2), round(depth, 2))
        self.parts: list[Part] = []
        self.start: tuple[float, float, float] | None = None

    def furnish(
        self, named: Sequence[tuple[str, Fixture]] | None
    ) -> tuple[Floor, tuple[Part, ...], tuple[float, float, float]] | None:
        """Return floor, parts and start, or None if a part does not fit."""
        if named is None:
            count = int(self.rng.integers(1, 3))
            kinds = self.rng.choice(list(OPENABLE), count, replace=False)
            named = _name_fixtures([str(kind) for kind in kinds], 0)
        for name, own in named:
            if not self._add_first_fitting(self._propose_openables(name, own)):
                return None
        for k in range(self.settings.tables):
            if not self._add_first_fitting(self._propose_tables(f"table_{k + 1}")):
                return None
        start = self._sample_start()
        if start is None:
            return None
        self.start = start
        if not self._add_clutter():
            return None
        carried: list[Part] = []
        for k, kind in enumerate(self.settings.carried):
            (table,) = (part for part in self.parts if part.name == "table_1")
            carried.append(self._place_carried_object(kind, k, table))
        return self.floor, (*self.parts, *carried), start

    def _add_clutter(self) -> bool:
        """Add random furniture; return whether all of it fits."""
        proposals = (
            ("box", self._propose_boxes),
            ("box", self._propose_boxes),
            ("shelf", self._propose_shelves),
            ("table", self._propose_tables),
        )
        occupied = sum(part.footprint.length * part.footprint.width for part in self.parts)
        free = self.floor.width * self.floor.depth - occupied
        count = round(self.settings.clutter * _DENSITY * free)
        for k in range(count):
            kind, propose = proposals[int(self.rng.integers(4))]
            number = k + 1 + self.settings.tables
            if not self._add_first_fitting(propose(f"{kind}_{number}")):
                return False
        return True

    def _add_first_fitting(self, proposals: Iterator[Part]) -> bool:
        """Add the first of some proposed parts that fits; return whether one does."""
        for part in itertools.islice(proposals, _MAX_TRIES):
            if self._does_fit(part):
                self.parts.append(part)
                return True
        return False

    def _does_fit(self, part: Part) -> bool:
        """Return whether a part is clear of the others, and keeps the required floor free."""
        own = part.footprint
        if part.side is None and not self.floor.contains(own):
            return False
        if part.clear_floor and not self.floor.contains(part.clear_floor):
            return False
        if any(self._are_close(part, other) for other in self.parts):
            return False
        footprints = [one.footprint for one in (*self.parts, part)]
        places = [
            one.standing_place for one in (*self.parts, part) if one.standing_place is not None
        ]
        if self.start is not None:
            position = self.start[:2]
            if not self.floor.find_free([own], self.radius, [position])[0]:
                return False
            places.append(position)
        return self.floor.is_connected(footprints, self.radius, places)

    def _are_close(self, part: Part, other: Part) -> bool:
        """Return whether a part is too close to another one, or to the floor before it."""
        pairs = [
            (part.footprint, other.footprint),
            (part.footprint, other.clear_floor),
            (other.footprint, part.clear_floor),
        ]
        for footprint, floor in pairs:
            if floor is not None and footprint.compute_gap(floor) < self.settings.gap:
                return True
        return False

    def _sample_start(self) -> tuple[float, float, float] | None:
        """Return a start from which the robot reaches all places to stand, or None."""
        footprints = [part.footprint for part in self.parts]
        places = [part.standing_place for part in self.parts if part.standing_place is not None]
        half = np.array([self.floor.width, self.floor.depth]) / 2.0
        for _ in range(_MAX_STARTS):
            pose = self.rng.uniform([*-half, -math.pi], [*half, math.pi])
            x, y, yaw = (round(float(value), 3) for value in pose)
            if not self.floor.find_free(footprints, self.radius, [[x, y]])[0]:
                continue
            if self.floor.is_connected(footprints, self.radius, [*places, (x, y)]):
                return x, y, yaw
        return None

    def _sample_wall_position(self, width: float) -> tuple[int, float]:
        """Return a random side, and a position along its wall for a part of a width [m]."""
        side = int(self.rng.integers(4))
        reach = max(self.floor.compute_half_length(side) - width / 2.0, 0.0)
        return side, round(float(self.rng.uniform(-reach, reach)), 3)

    def _sample_frame(self, yaw: float) -> Frame:
        """Return a frame anywhere on the floor."""
        half = np.array([self.floor.width, self.floor.depth]) / 2.0
        x, y = (round(float(value), 3) for value in self.rng.uniform(-half, half))
        return Frame(x, y, yaw)

    def _sample_size(self, *intervals: tuple[float, float]) -> tuple[float, ...]:
        """Return random lengths, rounded to the centimetre [m]."""
        return tuple(round(float(self.rng.uniform(*interval)), 2) for interval in intervals)

    def _propose_openables(self, name: str, own: Fixture) -> Iterator[Part]:
        while True:
            side, along = self._sample_wall_position(1.0)
            yield parts.make_openable(name, own, self.floor, side, along, self.settings.front)

    def _propose_tables(self, name: str) -> Iterator[Part]:
        while True:
            depth, width, height = self._sample_size((0.6, 0.9), (0.8, 1.6), (0.70, 0.78))
            side, along = self._sample_wall_position(width)
            wall = self.floor.make_wall_frame(side, along)
            if self.rng.random() < _AT_WALL:
                frame = Frame(*wall.transform_point(-depth / 2.0 - parts.AIR, 0.0), wall.yaw)
            else:
                frame = self._sample_frame(wall.yaw)
            yield parts.make_table(name, frame, (depth, width, height))

    def _propose_shelves(self, name: str) -> Iterator[Part]:
        while True:
            depth, width, height = self._sample_size((0.28, 0.4), (0.6, 1.2), (1.2, 2.0))
            boards = int(self.rng.integers(4, 6))
            side, along = self._sample_wall_position(width)
            frame = self.floor.make_wall_frame(side, along)
            yield parts.make_shelf(name, frame, (depth, width, height), boards)

    def _propose_boxes(self, name: str) -> Iterator[Part]:
        colour = _COLOURS[int(self.rng.integers(len(_COLOURS)))]
        while True:
            size = self._sample_size((0.25, 0.8), (0.25, 0.8), (0.3, 1.4))
            yaw = round(float(self.rng.uniform(-math.pi, math.pi)), 3)
            yield parts.make_box(name, self._sample_frame(yaw), size, colour)

    def _place_carried_object(self, kind: str, number: int, on: Part) -> Part:
        """Return a free object on a table, near the side at which the robot can stand."""
        depth, width, _ = on.size
        count = len(self.settings.carried)
        slot = (width - 2.0 * _EDGE) / count  # each object has its own part of the edge
        y = -width / 2.0 + _EDGE + slot * (number + float(self.rng.uniform(0.25, 0.75)))
        x = -depth / 2.0 + float(self.rng.uniform(_EDGE, 0.3))
        name = _number_equal_names(self.settings.carried)[number]
        return parts.make_carried_object(name, kind, on, x, y)


def _compute_turning_radius(robot: Robot) -> float:
    """Return the radius of a disc in which a robot with its arm at home turns freely [m]."""
    data = robot.model.createData()
    shapes = robot.collision.createData()
    q = robot.coordinates.q(np.concatenate([np.zeros(3), robot.home]))
    pin.updateGeometryPlacements(robot.model, data, robot.collision, shapes, q)
    reach = 0.0
    for shape, placement in zip(robot.collision.geometryObjects, shapes.oMg, strict=True):
        low, high = compute_world_box(shape.geometry, placement)
        farthest = np.maximum(np.abs(low[:2]), np.abs(high[:2]))
        reach = max(reach, float(np.hypot(*farthest)))
    return reach + max(_TURNING, START_CLEARANCE)
