"""Tolerances of validation."""

from __future__ import annotations

from dataclasses import dataclass, fields

from vkc_pin.utils.arguments import check_number


@dataclass(frozen=True)
class Tolerances:
    """Errors that validation accepts. Values of 1e-9 to 10; anything else raises an InputError.

    Attributes:
        closure_position: Position error of a grasp [m].
        closure_angle: Orientation error of a grasp [rad].
        goal_position: Position error of a goal, ξ_goal [m].
        goal_angle: Orientation error of a goal, ξ_goal [rad].
    """

    closure_position: float = 1e-3
    closure_angle: float = 1e-3
    goal_position: float = 1e-3
    goal_angle: float = 1e-3

    def __post_init__(self) -> None:
        expected = "a positive finite number, from 1e-09 to 10"
        for item in fields(self):
            field = f"Tolerances.{item.name}"
            value = check_number(getattr(self, item.name), field, expected, low=1e-9, high=10.0)
            object.__setattr__(self, item.name, value)
