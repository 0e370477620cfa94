"""Defines parts of a trajectory with constant holds."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.utils.arguments import check_integer, check_mapping, check_number, check_text
from vkc_pin.world.scene.hold import Hold, check_hold_order, make_holds

_FIELDS = ("name", "first", "last", "held", "by", "deviation", "opening")


@dataclass(frozen=True)
class PhaseSpan:
    """A part of a trajectory with constant holds.

    Attributes:
        name: Name of the phase, e.g. "reach door.handle".
        first, last: Its first and last waypoint; the next phase begins at `last`.
        holds: Holds during the phase, each after the one it depends on; `"cup" in phase.holds` is
            whether the cup is held.
        opening: Gripper opening [m]; None: as in the robot's rest configuration. From another
            opening, the fingers move between the first two waypoints.

    Raises:
        InputError: An object is held through one that is not held, or a number is out of range.
    """

    name: str
    first: int
    last: int
    holds: tuple[Hold, ...] = ()
    opening: float | None = None

    def __post_init__(self) -> None:
        check_text(self.name, "PhaseSpan.name")
        for name in ("first", "last"):
            object.__setattr__(
                self, name, check_integer(getattr(self, name), f"PhaseSpan.{name}", low=0)
            )
        object.__setattr__(self, "holds", check_hold_order(self.holds))
        if self.opening is not None:
            field, expected = "PhaseSpan.opening", "a distance [m]"
            opening = check_number(self.opening, field, expected, low=0.0, high=1.0)
            object.__setattr__(self, "opening", opening)

    @property
    def held(self) -> dict[str, str]:
        """Object → attachment of the held objects."""
        return {hold.object: hold.attachment for hold in self.holds}

    def to_dict(self) -> dict[str, Any]:
        """Return plain data; `by` maps objects held through another to its "<object>.<link>".

        `deviation` maps objects to that of their holds, if there is any.
        """
        by = {hold.object: hold.frame for hold in self.holds if hold.by}
        data = {
            "name": self.name,
            "first": self.first,
            "last": self.last,
            "held": self.held,
            "by": by,
        }
        deviation = {hold.object: list(hold.deviation) for hold in self.holds if hold.deviation}
        more = {"deviation": deviation or None, "opening": self.opening}
        return data | {name: value for name, value in more.items() if value is not None}

    @classmethod
    def from_dict(cls, data: Any, where: str) -> PhaseSpan:
        """Return the phase described by data from `to_dict`, in the field `where`.

        Raises:
            InputError: A field is missing or invalid.
        """
        phase = check_fields(check_mapping(data, where), _FIELDS, where)
        held = make_holds(
            get_required_field(phase, "held", where),
            phase.get("by"),
            deviation=phase.get("deviation"),
        )
        name, first, last = (
            get_required_field(phase, key, where) for key in ("name", "first", "last")
        )
        return cls(name, first, last, held, phase.get("opening"))


def check_fields(data: Mapping[str, Any], known: Collection[str], where: str) -> Mapping[str, Any]:
    """Return data of a motion. Raises `UnknownNameError` if `where` has another field."""
    for name in data:
        if name not in known:
            raise UnknownNameError("field", str(name), known, field=where or None)
    return data


def get_required_field(data: Mapping[str, Any], name: str, where: str = "") -> Any:
    """Return an entry of a motion's data. Raises `InputError` if it is missing."""
    if name not in data:
        field = ".".join(part for part in (where, name) if part)
        raise InputError("this is missing from a trajectory", field=field)
    return data[name]
