"""Defines parts of a trajectory with constant holds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import Field

from vkc_pin.utils.arguments import check_integer, check_number, check_text
from vkc_pin.world.files.fields import Count, Finite, Measured, Schema, Text, require_length
from vkc_pin.world.scene.hold import Hold, check_hold_order, make_holds


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
            waypoint = check_integer(getattr(self, name), f"PhaseSpan.{name}", low=0)
            object.__setattr__(self, name, waypoint)
        object.__setattr__(self, "holds", check_hold_order(self.holds))
        if self.opening is not None:
            opening = check_number(
                self.opening, "PhaseSpan.opening", "a distance [m]", low=0.0, high=1.0
            )
            object.__setattr__(self, "opening", opening)

    @property
    def held(self) -> dict[str, str]:
        """Object → attachment of the held objects."""
        return {hold.object: hold.attachment for hold in self.holds}

    def to_dict(self) -> dict[str, Any]:
        """Return the phase as plain data, with the fields of `PhaseSchema`."""
        data = {
            "name": self.name,
            "first": self.first,
            "last": self.last,
            "held": self.held,
            "by": {hold.object: hold.frame for hold in self.holds if hold.by},
        }
        deviation = {hold.object: list(hold.deviation) for hold in self.holds if hold.deviation}
        if deviation:
            data["deviation"] = deviation
        if self.opening is not None:
            data["opening"] = self.opening
        return data


class PhaseSchema(Schema):
    """A phase in files, which state holds by the names of objects.

    `by` maps objects held through another to its "<object>.<link>", `deviation` maps objects to
    that of their holds.
    """

    name: Text
    first: Count
    last: Count
    held: dict[str, Text]
    by: dict[str, Text] = Field(default_factory=dict)
    deviation: dict[str, Annotated[tuple[Finite, ...], require_length(6)]] | None = None
    opening: Measured | None = None

    def make_phase(self) -> PhaseSpan:
        """Return the phase. Raises `InputError` if its holds do not fit together."""
        holds = make_holds(self.held, self.by, deviation=self.deviation)
        return PhaseSpan(self.name, self.first, self.last, holds, self.opening)
