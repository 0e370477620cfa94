"""Checks a velocity with which a motion of a robot begins or ends."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import check_array, check_choice, check_mapping, check_number
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.robot import Robot

_EXPECTED = "a velocity [m/s] or [rad/s]"
_LIMIT_SLACK = 1e-6  # relative excess over a limit that counts as rounding
# [m/s], sideways, or missing for the turn: what validation accepts along motions
_MAX_SLIP = 1e-3


def make_robot_velocity(
    robot: Robot,
    configuration: Floats,
    velocity: ArrayLike | Mapping[str, float],
    field: str = "velocity",
) -> Floats:
    """Return a checked velocity of a robot, shape (n,), [m/s] and [rad/s].

    Args:
        robot: Robot of n coordinates.
        configuration: Its configuration, shape (n,).
        velocity: Velocity of all coordinates, shape (n,), or coordinate → velocity; those that are
            not named are at rest.
        field: Name of the argument, for errors.

    Raises:
        UnknownNameError: The robot has no such coordinate.
        InputError: Wrong size; a velocity that is not finite, beyond its limit, or with which the
            base would slip or, being fixed, move.
    """
    names = robot.coordinates.names
    if isinstance(velocity, Mapping):
        given = _fill_coordinates(robot, velocity, field)
    else:
        given = check_array(velocity, field)
    if given.shape != configuration.shape:
        raise InputError(
            "wrong number of values", field=field, expected=configuration.shape, got=given.shape
        )
    units = robot.coordinates.units
    for name, value, limit, unit in zip(names, given, robot.velocity, units, strict=True):
        check_number(float(value), f"{field}.{name}", _EXPECTED)
        if abs(value) > limit * (1.0 + _LIMIT_SLACK):
            raise InputError(
                "faster than the joint's limit",
                field=f"{field}.{name}",
                expected=f"at most {limit:g} {unit}/s",
                got=float(value),
            )
    _check_base(robot, float(configuration[2]), given[:3], field)
    given.setflags(write=False)
    return given


def _fill_coordinates(robot: Robot, velocity: Mapping[str, float], field: str) -> Floats:
    """Return the velocities of all coordinates; those that are not named are at rest."""
    names = robot.coordinates.names
    filled = np.zeros(len(names))
    for name, value in check_mapping(velocity, field, "coordinate → velocity").items():
        check_choice(name, names, f"coordinate of robot '{robot.name}'", field)
        filled[names.index(name)] = check_number(value, f"{field}.{name}", _EXPECTED)
    return filled


def _check_base(robot: Robot, yaw: float, velocity: Floats, field: str) -> None:
    """Check that a base can move with a velocity (x, y, yaw), shape (3,), in the world frame."""
    if robot.base == "fixed" and velocity.any():
        problem = "a fixed base does not move"
        raise InputError(problem, field=field, expected="0 for the base", got=velocity.tolist())
    if robot.base not in ("differential", "ackermann"):
        return
    vx, vy, turn = velocity.tolist()
    along = np.cos(yaw) * vx + np.sin(yaw) * vy
    aside = np.cos(yaw) * vy - np.sin(yaw) * vx
    if abs(aside) > _MAX_SLIP:
        raise InputError(
            "the base would slip sideways",
            field=field,
            expected="a velocity along its heading",
            got=f"{aside:.3g} m/s sideways",
        )
    if robot.base == "ackermann" and robot.turning_radius * abs(turn) > abs(along) + _MAX_SLIP:
        raise InputError(
            "the base would turn more tightly than it can",
            field=f"{field}.{robot.coordinates.names[2]}",
            expected=f"a turning radius of at least {robot.turning_radius:g} m",
            got=turn,
        )
