"""Converts joint goals of the robot to intervals of its coordinates, and tells them from poses."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.world.models.coordinates import MovedJoint
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.shapes import LIMIT_SLACK
from vkc_pin.world.scene.robot_velocity import make_robot_velocity
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Configure, Reach

_ROUNDING = 1e-4
"""Excess of a goal over a limit that is cut off [rad] or [m].

Files round π to 3.1416, and limits to 3.14159; validation accepts ten times as much at any goal.
"""
_Interval = tuple[float, float]


def find_configuration(scene: Scene, step: Configure, where: str) -> dict[str, _Interval]:
    """Return coordinate of the robot → accepted interval [rad] or [m], within its limits.

    A coupled joint p = f · z + o with the value v ± t is a goal of its leader's coordinate z:
    (v − o) / f ± t / |f|.

    Raises:
        UnknownNameError: The robot has no such joint.
        InputError: A joint cannot move, a value is beyond its limits, or the values of coupled
            joints contradict each other.
    """
    found = dict[str, _Interval]()
    for joint, value in step.joints.items():
        field = f"{where}.joints[{joint!r}]"
        move = _find_planned_joint(scene.robot, joint, field)
        name = scene.robot.coordinates.names[move.coordinate]
        middle = (value - move.offset) / move.factor
        deviation = step.get_tolerance(joint) / abs(move.factor)
        interval = _intersect(scene, name, (middle - deviation, middle + deviation), value, field)
        low, high = interval
        if name in found:
            low_before, high_before = found[name]
            low = max(low, low_before)
            high = min(high, high_before)
            if low > high + LIMIT_SLACK:
                problem = f"the coupled joints of '{name}' contradict each other"
                expected = f"a value with which '{name}' is from {low_before:g} to {high_before:g}"
                raise InputError(problem, field=field, expected=expected, got=value)
        # Rounding may have exchanged the ends.
        found[name] = (min(low, high), max(low, high))
    return found


def find_end_velocities(scene: Scene, step: Configure, where: str) -> dict[str, float]:
    """Return coordinate of the robot → velocity at the end of a step, where it is not 0.

    A coupled joint p = f · z + o with the velocity v has a leader with the velocity v / f.

    Raises:
        UnknownNameError: The robot has no such joint.
        InputError: A joint cannot move, a velocity is beyond its limit, the base cannot move so, or
            the velocities of coupled joints contradict each other.
    """
    robot = scene.robot
    field = f"{where}.velocities"
    found = dict[str, float]()
    for joint, value in step.velocities.items():
        move = _find_planned_joint(robot, joint, f"{field}[{joint!r}]")
        name = robot.coordinates.names[move.coordinate]
        velocity = value / move.factor
        if not np.isclose(found.setdefault(name, velocity), velocity):
            problem = f"the coupled joints of '{name}' contradict each other"
            expected = f"{found[name] * move.factor:g}"
            raise InputError(problem, field=f"{field}[{joint!r}]", expected=expected, got=value)
    end = scene.start.copy()
    intervals = find_configuration(scene, step, where)
    for name, interval in intervals.items():
        end[robot.coordinates.index(name)] = np.mean(interval)
    x_name, y_name, yaw_name = robot.coordinates.names[:3]
    is_wheeled = robot.base in ("differential", "ackermann")
    if is_wheeled and {x_name, y_name} & {*found} and yaw_name not in intervals:
        problem = "a base on wheels moves along its heading"
        raise InputError(problem, field=f"{where}.joints", expected=f"a value of '{yaw_name}'")
    checked = make_robot_velocity(robot, end, found, field)
    moving = zip(robot.coordinates.names, checked.tolist(), strict=True)
    return {name: velocity for name, velocity in moving if velocity}


def check_pose_is_unambiguous(scene: Scene, step: Reach, where: str) -> None:
    """Check that a list of numbers for a pose cannot be read as values of the arm's joints.

    Raises:
        InputError: It can.
    """
    robot = scene.robot
    joints = robot.coordinates.names[3:]
    if step.numbers is None or len(step.numbers) != len(joints):
        return
    values = np.array(step.numbers)
    is_within = (values >= robot.lower[3:]) & (values <= robot.upper[3:])
    if not is_within.all():
        return
    form = "x, y, z, roll, pitch, yaw" if len(values) == 6 else "x, y, z, qx, qy, qz, qw"
    named = ", ".join(joints)
    problem = f"it can be read as a pose ({form}) and as values of the joints {named}"
    expected = "a tuple or a pinocchio.SE3 for the pose; Configure for the joints"
    raise InputError(problem, field=where, expected=expected, got=list(step.numbers))


def _find_planned_joint(robot: Robot, joint: str, field: str) -> MovedJoint:
    known = robot.planned_joints
    if joint in known:
        return known[joint]
    if joint in _list_movable_joints(robot):
        problem = f"joint '{joint}' is locked: it is not one that robot '{robot.name}' plans"
        expected = f"one of {', '.join(known)}"
        raise InputError(problem, field=field, expected=expected, got=joint)
    raise UnknownNameError(f"joint of robot '{robot.name}'", joint, known, field=field)


def _list_movable_joints(robot: Robot) -> Iterator[str]:
    for element in robot.file.root.findall("joint"):
        if element.get("type") != "fixed":
            yield element.get("name", "")


def _intersect(scene: Scene, name: str, interval: _Interval, value: float, field: str) -> _Interval:
    """Return the part of an interval of a coordinate that is within its limits."""
    robot = scene.robot
    column = robot.coordinates.index(name)
    lower = float(robot.lower[column])
    upper = float(robot.upper[column])
    limits = "the joint's limits"
    if column < 2:
        arena_low, arena_high = scene.arena[2 * column : 2 * column + 2]
        lower = max(lower, float(arena_low))
        upper = min(upper, float(arena_high))
        limits = "the arena"
    if column < 3 and robot.base == "fixed":
        lower = float(scene.start[column])
        upper = lower
        limits = "the place of the fixed base"
    low, high = interval
    if low > upper + _ROUNDING or high < lower - _ROUNDING:
        expected = f"{lower:g} to {upper:g}" if lower < upper else f"{lower:g}"
        raise InputError(f"outside {limits}", field=field, expected=expected, got=f"{value:.12g}")
    return min(max(low, lower), upper), max(min(high, upper), lower)
