"""Defines the options of planning."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal, Self, get_args

from vkc_pin.errors import InputError, format_value
from vkc_pin.utils.arguments import check_choice, check_integer, check_mapping, check_number

Objective = Literal["path_length", "control_effort"]
OBJECTIVES: tuple[Objective, ...] = get_args(Objective)
_MIN = 1e-9
_MAX = 1e9
_RANGES = {
    "dt": (1e-3, 60.0),
    "grasp_time": (_MIN, 3600.0),
    "approach_time": (_MIN, 3600.0),
    "approach": (_MIN, 10.0),
    "payload_factor": (_MIN, 1e3),
    "jerk_time": (0.005, 10.0),  # or 0; motions have a knot every 0.6 ms at the lower bound
}
# Beyond these, planning takes hours and gigabytes.
_MAX_INTEGERS = {
    "reach_waypoints": 500,
    "turn_waypoints": 500,
    "move_waypoints": 500,
    "max_refinements": 4,
    "contact_slots": 64,
    "max_outer": 10_000,
    "max_iterations": 100_000,
    "max_restarts": 1000,
}


@dataclass(frozen=True)
class Options:
    """Options of planning, which are checked at construction; an `InputError` names the field.

    Attributes:
        dt: Shortest time between two waypoints [s].
        grasp_time: Time at rest for the gripper to close or open [s].
        jerk_time: Shortest time in which an acceleration rises to its limit [s], at least 5 ms,
            which limits jerks; 0: unlimited.
        reach_waypoints: Segments of a phase that drives or reaches, carrying an object or not.
        turn_waypoints: Segments of a phase that releases a latch.
        move_waypoints: Segments of a phase that moves a grasped object.
        max_refinements: How often the segments of a phase may double where the motion is valid at
            the waypoints, but not in between; 0: their numbers are fixed.
        dist_safe: Clearance at the waypoints [m].
        self_distance: Clearance between links of the robot [m]. Links that are always closer keep
            half of their largest distance.
        grasp_clearance: Default clearance between the touch links and an object near its grasp [m].
        objective: "path_length", or "control_effort" for the squares of eq. 1.
        velocity_weight_base: W_vel of eq. 1 for the base position and prismatic joints [1/m²].
        velocity_weight_heading: W_vel for the heading of the base [1/rad²].
        velocity_weight_arm: W_vel for revolute joints of the arm [1/rad²].
        velocity_weight_object: W_vel for revolute joints of objects and virtual joints [1/rad²].
        acceleration_weight: W_acc of eq. 1, as a multiple of W_vel [s²].
        approach: Length of the straight approach to a grasp [m].
        approach_time: Duration of the approach, at `dt` per waypoint [s].
        payload_factor: Largest mass of carried objects, as a multiple of the payload that the
            robot's description states.
        contact_slots: Maximum number of witness planes per waypoint.
        contact_reach: Distance of pairs below which they get a witness plane [m].
        max_outer: Rounds of the witness-plane loop.
        max_iterations: Ipopt iterations per round.
        penalty: Initial weight of the exact ℓ1 penalty on clearance slack.
        max_restarts: Number of initial guesses; in a chore, number of attempts per motion.
    """

    dt: float = 0.25
    grasp_time: float = 1.0
    jerk_time: float = 0.0
    reach_waypoints: int = 40
    turn_waypoints: int = 6
    move_waypoints: int = 30
    max_refinements: int = 2
    dist_safe: float = 0.02
    self_distance: float = 0.02
    grasp_clearance: float = 0.005
    objective: Objective = "path_length"
    velocity_weight_base: float = 1.0
    velocity_weight_heading: float = 0.025
    velocity_weight_arm: float = 0.025
    velocity_weight_object: float = 0.025
    acceleration_weight: float = 0.3
    approach: float = 0.08
    approach_time: float = 1.0
    payload_factor: float = 1.0
    contact_slots: int = 4
    contact_reach: float = 0.25
    max_outer: int = 40
    max_iterations: int = 200
    penalty: float = 50.0
    max_restarts: int = 4

    def __post_init__(self) -> None:
        for item in fields(self):
            value: Any = getattr(self, item.name)
            if item.name == "objective":
                value = _check_objective(value)
            elif item.type == "int":
                value = _check_count(item.name, value)
            else:
                value = _check_quantity(item.name, value)
            # The checked value has a type of Python: JSON has no NumPy types.
            object.__setattr__(self, item.name, value)

    @classmethod
    def paper(cls, **changes: Any) -> Self:
        """Return options that minimise eq. 1 of the paper with all weights 1, since it gives none.

        Args:
            **changes: Other fields.
        """
        values: dict[str, Any] = {"objective": "control_effort"}
        for item in fields(cls):
            if item.name.startswith("velocity_weight"):
                values[item.name] = 1.0
        values.update(changes)
        return cls(**values)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Return options from plain data, such as those of a saved plan.

        Raises:
            UnknownNameError: There is no such option.
            InputError: A value is invalid.
        """
        given = check_mapping(data, "options")
        known = [item.name for item in fields(cls)]
        for name in given:
            check_choice(name, known, "option", f"options.{name}")
        if "dist_safe" in given:
            # Files without `self_distance` used `dist_safe` for all pairs.
            given.setdefault("self_distance", given["dist_safe"])
        return cls(**given)

    @property
    def largest_margin(self) -> float:
        """Largest clearance of any pair [m]."""
        return max(self.dist_safe, self.self_distance)

    def steps(self, seconds: float) -> int:
        """Return the number of steps of `dt` in a time [s], at least 1."""
        return max(1, round(seconds / self.dt))


def _check_objective(value: Any) -> str:
    if not isinstance(value, str) or value not in OBJECTIVES:
        expected = " or ".join(map(repr, OBJECTIVES))
        got = format_value(value)
        raise InputError("unknown", field="Options.objective", expected=expected, got=got)
    return str(value)


def _check_count(name: str, value: Any) -> int:
    least = 0 if name == "max_refinements" else 1
    return check_integer(value, f"Options.{name}", low=least, high=_MAX_INTEGERS[name])


def _check_quantity(name: str, value: Any) -> float:
    field = f"Options.{name}"
    low, high = _RANGES.get(name, (_MIN, _MAX))
    expected = f"a positive finite number, from {low:g} to {high:g}"
    may_be_zero = name == "jerk_time"
    if may_be_zero:
        expected += ", or 0"
    number = check_number(value, field, expected, low=0.0, high=high)
    is_valid = low <= number or (may_be_zero and number == 0.0)
    if not is_valid:
        raise InputError("out of range", field=field, expected=expected, got=number)
    return number
