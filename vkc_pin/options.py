"""Options of planning, each with its unit and default."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Literal, Self

from vkc_pin.errors import InputError, format_value
from vkc_pin.utils.arguments import check_integer, check_number

__all__ = ["Options"]

OBJECTIVES = ("path_length", "control_effort")
_SMALLEST, _LARGEST = 1e-9, 1e9  # of numbers
_RANGES = {
    "dt": (1e-3, 60.0),
    "grasp_time": (_SMALLEST, 3600.0),
    "approach_time": (_SMALLEST, 3600.0),
    "approach": (_SMALLEST, 10.0),
    "jerk_time": (0.0, 10.0),
}
_MOST = {  # of whole numbers: beyond these, planning takes hours and gigabytes
    **dict.fromkeys(("reach_waypoints", "turn_waypoints", "move_waypoints"), 500),
    **{"contact_slots": 64, "max_outer": 10_000, "max_iterations": 100_000, "max_restarts": 1000},
}


@dataclass(frozen=True)
class Options:
    """How to plan. Every field is checked when the object is made; an InputError names what is out of range.

    Attributes:
        dt: Least time between two waypoints [s]; motions that are too long for it take more.
        grasp_time: How long the robot stands still at a grasp or release, for the gripper to close
            or open [s].
        jerk_time: Least time in which an acceleration grows from none to its limit [s]: jerks are
            limited to that limit over this, and accelerations do not jump. 0: they may.
        reach_waypoints: Segments of a phase that drives or reaches, with or without something in
            the hand.
        turn_waypoints: Segments of a phase in which a latch is released.
        move_waypoints: Segments of a phase in which a held object is moved.
        dist_safe: Clearance to keep at the waypoints [m].
        self_distance: The same between links of the robot; those that cannot get so far apart keep
            half of what they can [m].
        grasp_clearance: Clearance of the gripper's touch links to an object near its grasp, where
            the attachment states none [m].
        objective: "path_length", or "control_effort" for the squares of eq. 1.
        velocity_weight_base: W_vel of eq. 1 for the base's place, and for every joint that slides
            [1/m²].
        velocity_weight_heading: W_vel for its heading [1/rad²].
        velocity_weight_arm: W_vel for the arm's joints that turn [1/rad²].
        velocity_weight_object: W_vel for those of objects and for virtual joints that turn
            [1/rad²].
        acceleration_weight: W_acc of eq. 1, as a multiple of W_vel [s²].
        approach: Length of the straight way on which a hand comes to what it grasps [m].
        approach_time: How long it takes, at `dt` a waypoint [s].
        contact_slots: Witness planes a waypoint can hold.
        contact_reach: Pairs closer than this get a witness plane [m].
        max_outer: Rounds of the witness-plane loop.
        max_iterations: Ipopt iterations in one round.
        penalty: First weight of the exact ℓ1 penalty on clearance slack; it is adapted.
        max_restarts: How many different seeds are tried; in a chore, how often a motion is searched
            for.
    """

    dt: float = 0.25
    grasp_time: float = 1.0
    jerk_time: float = 0.0
    reach_waypoints: int = 40
    turn_waypoints: int = 6
    move_waypoints: int = 30
    dist_safe: float = 0.02
    self_distance: float = 0.02
    grasp_clearance: float = 0.005
    objective: Literal["path_length", "control_effort"] = "path_length"
    velocity_weight_base: float = 1.0
    velocity_weight_heading: float = 0.025
    velocity_weight_arm: float = 0.025
    velocity_weight_object: float = 0.025
    acceleration_weight: float = 0.3
    approach: float = 0.08
    approach_time: float = 1.0
    contact_slots: int = 4
    contact_reach: float = 0.25
    max_outer: int = 40
    max_iterations: int = 200
    penalty: float = 50.0
    max_restarts: int = 4

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            field = f"Options.{item.name}"
            if item.name == "objective":
                if not isinstance(value, str) or value not in OBJECTIVES:
                    raise InputError(
                        "unknown",
                        field=field,
                        expected=" or ".join(map(repr, OBJECTIVES)),
                        got=format_value(value),
                    )
                object.__setattr__(self, item.name, str(value))
            elif item.type == "int":
                value = check_integer(
                    value, field, low=1, high=_MOST[item.name]
                )  # NumPy's own integers do not go into JSON
                object.__setattr__(self, item.name, value)
            else:
                low, high = _RANGES.get(item.name, (_SMALLEST, _LARGEST))
                expected = f"a {'positive ' if low else ''}finite number, from {low:g} to {high:g}"
                object.__setattr__(
                    self, item.name, check_number(value, field, expected, low=low, high=high)
                )

    @classmethod
    def paper(cls, **changes: Any) -> Self:
        """Return options with which eq. 1 of the paper is minimised: squares, all weights 1 (the paper gives no numbers).

        Args:
            **changes: Other fields.
        """
        weights = dict.fromkeys(
            (item.name for item in fields(cls) if item.name.startswith("velocity_weight")), 1.0
        )
        return cls(**{"objective": "control_effort", **weights, **changes})

    @property
    def largest_margin(self) -> float:
        """The largest clearance that any pair keeps [m]."""
        return max(self.dist_safe, self.self_distance)

    def steps(self, seconds: float) -> int:
        """Return how many steps of `dt` a time [s] takes, at least 1."""
        return max(1, round(seconds / self.dt))
