"""Stretches of a motion in which the same things are held."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import check_integer, check_mapping, check_number, check_text
from vkc_pin.world.scene.hold import Hold, check_hold_order, make_holds

__all__ = ["PhaseSpan", "get_required"]


@dataclass(frozen=True)
class PhaseSpan:
    """A stretch of a trajectory in which the same things are held.

    Attributes:
        name: What happens in it, e.g. "reach door.handle".
        first, last: Its waypoints; `last` is the next phase's `first`.
        holds: All that is held in it, each hold after the one it depends on.
        opening: How far the gripper is open in it [m]; None: as the robot rests. If it was
            otherwise in the phase before, the fingers move from the first waypoint to the second.

    Raises:
        InputError: Something is held through what is not, or an opening is none.
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
            object.__setattr__(
                self,
                "opening",
                check_number(
                    self.opening, "PhaseSpan.opening", "a distance [m]", low=0.0, high=1.0
                ),
            )

    @property
    def held(self) -> dict[str, str]:
        """Object → attachment, for all that is held in it."""
        return {hold.object: hold.attachment for hold in self.holds}

    def to_dict(self) -> dict[str, Any]:
        """Return plain data of it; `by` names the link, "<object>.<link>", for what is held through another object."""
        by = {hold.object: hold.frame for hold in self.holds if hold.by}
        data = {
            "name": self.name,
            "first": self.first,
            "last": self.last,
            "held": self.held,
            "by": by,
        }
        return data if self.opening is None else {**data, "opening": self.opening}

    @classmethod
    def from_dict(cls, data: Any, where: str) -> PhaseSpan:
        """Return what `to_dict` made `data` of.

        Args:
            data: Plain data.
            where: The field that it stands in, for errors.

        Raises:
            InputError: Something is missing from it or does not fit.
        """
        phase = check_mapping(data, where)
        held = make_holds(get_required(phase, "held"), phase.get("by"))
        name, first, last = (get_required(phase, key) for key in ("name", "first", "last"))
        return cls(name, first, last, held, phase.get("opening"))


def get_required(data: Mapping[str, Any], name: str) -> Any:
    """Return an entry of a motion's data. Raises `InputError` if it is not there."""
    if name not in data:
        raise InputError("this is missing from a trajectory", field=name)
    return data[name]
