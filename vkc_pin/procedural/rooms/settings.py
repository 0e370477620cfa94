"""Defines the settings of random rooms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vkc_pin.errors import InputError, format_value
from vkc_pin.procedural.rooms.fixtures import list_openable_types
from vkc_pin.procedural.rooms.parts import CARRIED
from vkc_pin.utils.arguments import (
    check_choice,
    check_integer,
    check_list,
    check_mapping,
    check_text,
    is_number,
)
from vkc_pin.world.files.resources import check_path

__all__ = ["RoomSettings"]

_MAX_CARRIED = 4  # on one table


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
        for name, low, high in (("height", 2.1, 10.0), ("front", 1.5, 3.0), ("gap", 0.02, 1.0)):
            _check_range(name, getattr(self, name), low, high)
        expected = "two lengths of 4 to 20 m, the lower one first"
        if not isinstance(self.width, tuple | list) or len(self.width) != 2:
            raise InputError(
                "not an interval", field="width", expected=expected, got=format_value(self.width)
            )
        for value in self.width:
            _check_range("width", value, 4.0, 20.0)
        if self.width[0] > self.width[1]:
            raise InputError(
                "the interval is empty",
                field="width",
                expected=expected,
                got=format_value(self.width),
            )
        object.__setattr__(self, "width", tuple(map(float, self.width)))
        object.__setattr__(self, "tables", check_integer(self.tables, "tables", low=0, high=10))
        if self.objects is not None:
            object.__setattr__(
                self,
                "objects",
                tuple(map(_parse_openable, check_list(self.objects, "objects", "a list of types"))),
            )
        kinds: tuple[Any, ...] = check_list(self.carried, "carried", "a list of types")
        object.__setattr__(
            self,
            "carried",
            tuple(
                check_choice(kind, CARRIED, "object that is carried", "carried") for kind in kinds
            ),
        )
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


def _parse_openable(kind: Any) -> str | dict[str, Any]:
    """Return the type of an object that can be opened. Raises an error for an unknown name."""
    if isinstance(kind, Mapping):
        return check_mapping(kind, "objects")
    is_path = isinstance(kind, Path) or (
        isinstance(kind, str) and (kind.endswith((".yaml", ".yml")) or "/" in kind)
    )
    return (
        str(check_path(kind, "objects"))
        if is_path
        else check_choice(kind, list_openable_types(), "object that opens", "objects")
    )


def _parse_robot(robot: Any) -> str:
    """Return a robot's name, or the absolute path of its file or folder.

    Rooms are saved without a folder that paths could be relative to.
    """
    is_path = isinstance(robot, Path) or (
        isinstance(robot, str) and (robot.endswith((".urdf", ".yaml", ".yml")) or "/" in robot)
    )
    return (
        str(check_path(robot, "robot").resolve())
        if is_path
        else check_text(robot, "robot", "a robot's name, or the path of its file")
    )


def _check_range(name: str, value: Any, low: float, high: float) -> None:
    """Raise an error unless a setting is a number from `low` to `high`."""
    if not is_number(value) or not low <= value <= high:
        raise InputError(
            "out of range",
            field=name,
            expected=f"a number from {low:g} to {high:g}",
            got=format_value(value),
        )
