"""Tests robots that drive by odometry while they are localised in the scene."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

import vkc_pin as vkc
from vkc_pin.errors import InputError
from vkc_pin.execution import IdealRobot, LocalisedRobot, execute
from vkc_pin.world.trajectory.frames import invert_frame, place_base, place_motion

FRAME = np.array([0.3, -0.2, 0.4])  # of the odometry in the scene
SMALL = np.array([0.002, -0.001, 0.001])


@cache
def plan_motion() -> vkc.Plan:
    plan = vkc.plan(vkc.load_scene("door"), [vkc.GoTo(0.8, -0.3, 0.3)])
    assert plan.success, plan.summary()
    return plan


def make_robot(frame: ArrayLike) -> IdealRobot:
    """Return a robot that stands at the start of the plan, by an odometry in a frame."""
    scene = plan_motion().scene
    base = place_base(invert_frame(np.asarray(frame)), scene.start)[:3]
    return IdealRobot(scene.with_start(base=base), is_simulated=True)


def compute_misses(robot: IdealRobot, frame: ArrayLike, begin: float, count: int = 50) -> float:
    """Return by how much a robot is off the plan in the scene, from a time on, at most."""
    motion = plan_motion().trajectory
    most = 0.0
    for time in np.linspace(begin, begin + float(motion.times[-1]), count):
        state = robot.compute_state(float(time))
        actual = place_base(np.asarray(frame), state.positions)
        most = max(most, float(np.abs(actual - motion.at(time - begin)[: len(actual)]).max()))
    return most


def test_frames_invert_each_other() -> None:
    rows = np.array([[1.0, 2.0, 0.5, 7.0], [-3.0, 0.1, -2.0, 8.0]])
    there = place_base(FRAME, rows)
    np.testing.assert_allclose(place_base(invert_frame(FRAME), there), rows, atol=1e-12)
    np.testing.assert_array_equal(there[:, 3:], rows[:, 3:])
    # The origin of the frame's base lies at the frame.
    np.testing.assert_allclose(place_base(FRAME, np.zeros(3)), FRAME)
    # One metre ahead in a frame that is turned by a quarter is one metre to the left.
    np.testing.assert_allclose(
        place_base(np.array([0.0, 0.0, np.pi / 2]), np.array([1.0, 0.0, 0.0])),
        [0.0, 1.0, np.pi / 2],
        atol=1e-12,
    )


def test_placed_motion_is_the_motion_seen_from_elsewhere() -> None:
    motion = plan_motion().trajectory
    placed = place_motion(FRAME, motion)
    for time in np.linspace(*motion.times[[0, -1]], 30):
        there = place_base(FRAME, motion.at(time))
        np.testing.assert_allclose(placed.at(time), there, atol=1e-9)
        cos, sin = np.cos(FRAME[2]), np.sin(FRAME[2])
        x, y = motion.velocity(time)[:2]
        turned = [cos * x - sin * y, sin * x + cos * y]
        np.testing.assert_allclose(placed.velocity(time)[:2], turned, atol=1e-9)
        np.testing.assert_allclose(placed.velocity(time)[2:], motion.velocity(time)[2:])


def test_motion_is_executed_where_the_odometry_lies() -> None:
    robot = make_robot(FRAME)
    localised = LocalisedRobot(robot, lambda: FRAME)
    np.testing.assert_allclose(localised.read().positions, plan_motion().scene.start, atol=1e-12)
    result = execute(plan_motion(), localised)
    assert result.success, result
    assert result.count_decisions() == {"go on": len(result.cycles)}
    ((begin, _),) = robot.motions
    assert compute_misses(robot, FRAME, begin) < 1e-9


def test_measured_velocity_is_that_in_the_scene() -> None:
    robot = make_robot(FRAME)
    localised = LocalisedRobot(robot, lambda: FRAME)
    localised.send(plan_motion().trajectory, 0.0)
    localised.wait(1.0)
    expected = plan_motion().trajectory.velocity(1.0)[:9]
    np.testing.assert_allclose(localised.read().velocities, expected, atol=1e-9)
    assert np.abs(expected[:2]).max() > 0.05


def test_small_corrections_are_followed() -> None:
    """The robot ends where it should, though nothing is planned again."""
    robot = make_robot(np.zeros(3))
    localised = LocalisedRobot(robot, lambda: SMALL if robot.time > 1.0 else np.zeros(3))
    result = execute(plan_motion(), localised, tracking=0.004)
    assert result.success, result
    assert result.count_decisions() == {"go on": len(result.cycles)}
    end = place_base(SMALL, robot.compute_state(60.0).positions)
    np.testing.assert_allclose(end, plan_motion().trajectory.positions[-1][:9], atol=1e-9)


def test_localised_heading_jumps_by_a_whole_turn() -> None:
    """It is no correction if the localisation states -π instead of π."""
    before = np.array([0.0, 0.0, np.pi - 5e-4])
    after = np.array([0.0, 0.0, -np.pi + 5e-4])
    robot = make_robot(before)
    localised = LocalisedRobot(robot, lambda: after if robot.time > 1.0 else before)
    result = execute(plan_motion(), localised, tracking=0.004)
    assert result.success, result
    assert result.count_decisions() == {"go on": len(result.cycles)}
    turned = after + np.array([0.0, 0.0, 2.0 * np.pi])
    end = place_base(turned, robot.compute_state(60.0).positions)
    np.testing.assert_allclose(end, plan_motion().trajectory.positions[-1][:9], atol=1e-9)


def test_large_correction_is_planned_again() -> None:
    """The localisation finds out that it was 40 mm off: the robot goes on from where it is."""
    late = np.array([0.04, 0.0, 0.0])
    robot = make_robot(np.zeros(3))
    localised = LocalisedRobot(robot, lambda: late if robot.time > 1.0 else np.zeros(3))
    result = execute(plan_motion(), localised, lead=0.5, time_limit=60.0)
    assert result.success, result
    reasons = [cycle.reason for cycle in result.cycles if cycle.decision == "replan"]
    assert reasons
    assert "base_x is 0.04 m off" in reasons[0]
    end = place_base(late, robot.compute_state(60.0).positions)
    np.testing.assert_allclose(end, plan_motion().trajectory.positions[-1][:9], atol=1e-3)


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ({"robot": "husky"}, r"robot.*methods of `Robot`"),
        ({"locate": (0.0, 0.0, 0.0)}, "locate"),
        ({"step": -1.0}, "step"),
    ],
)
def test_wrong_arguments_are_named(arguments: dict[str, Any], error: str) -> None:
    given = {"robot": make_robot(FRAME), "locate": lambda: FRAME, **arguments}
    step = {key: value for key, value in given.items() if key == "step"}
    with pytest.raises(InputError, match=error):
        LocalisedRobot(given["robot"], given["locate"], **step)


@pytest.mark.parametrize("frame", [(0.0, 0.0), (0.0, 0.0, np.nan), "odom"])
def test_frame_that_is_none_is_named(frame: Any) -> None:
    localised = LocalisedRobot(make_robot(FRAME), lambda: frame)
    with pytest.raises(InputError, match="locate"):
        localised.read()
