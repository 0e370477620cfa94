"""Tests scenes during a motion, stops on its path, and plans of its rest."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import vkc_pin as vkc
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.planning.replan import find_remaining_steps
from vkc_pin.planning.stopping import brake
from vkc_pin.world.trajectory.splicing import extract_times

OPEN = vkc.Actuate("door", {"hinge": 1.2})


@cache
def plan_door(jerk_time: float = 0.0) -> vkc.Plan:
    plan = vkc.plan(vkc.load_scene("door"), [OPEN], options=vkc.Options(jerk_time=jerk_time))
    assert plan.success, plan.summary()
    return plan


@cache
def plan_through_door() -> vkc.Plan:
    """Plan that opens the door, releases it and drives."""
    plan = vkc.plan(vkc.load_scene("door"), [OPEN, vkc.Release(), vkc.GoTo(1.5, 0.3)])
    assert plan.success, plan.summary()
    return plan


def find_phase_begin(plan: vkc.Plan, name: str) -> float:
    """Return when the hand of a phase has closed, and the phase moves."""
    motion = plan.trajectory
    (phase,) = [phase for phase in motion.phases if phase.name.startswith(name)]
    return float(motion.times[phase.first + 1])


# --- scenes and parts of a motion
# ------------------------------------------------------------------------------------------------


def test_scene_during_a_motion_is_where_the_motion_is() -> None:
    plan = plan_door()
    motion = plan.trajectory
    for time in np.linspace(0.0, motion.times[-1], 8):
        scene = plan.scene_at(time)
        position = dict(zip(motion.names, motion.at(time), strict=True))
        np.testing.assert_allclose(scene.start, motion.at(time)[:9], atol=1e-9)
        np.testing.assert_allclose(scene.start_velocity, motion.velocity(time)[:9], atol=1e-9)
        hinge = scene.objects["door"].state[0]
        assert hinge == pytest.approx(position["door.hinge"], abs=1e-9)
        assert ("door" in scene.held) == (time >= find_phase_begin(plan, "turn"))
        there = plan.pose("door.panel", time)
        np.testing.assert_allclose(
            scene.objects["door"].link_placement("panel").homogeneous, there.homogeneous, atol=1e-9
        )


def test_while_the_hand_closes_the_object_is_not_held() -> None:
    plan = plan_door()
    begin = find_phase_begin(plan, "turn")
    assert plan.scene_at(begin - 1e-3).held == {}
    assert plan.scene_at(begin + 1e-3).held == {"door": "handle"}


@pytest.mark.parametrize(("begin", "end"), [(0.0, 1.0), (1.23, 4.56), (3.0, 3.2), (6.0, 7.35)])
def test_part_of_a_motion_is_the_motion_itself(begin: float, end: float) -> None:
    motion = plan_door().trajectory
    part = extract_times(motion, begin, min(end, float(motion.times[-1])))
    times = np.linspace(part.times[0], part.times[-1], 50)
    np.testing.assert_allclose(part.at(times), motion.at(times), atol=1e-12)
    np.testing.assert_allclose(part.velocity(times), motion.velocity(times), atol=1e-9)
    for phase in part.phases:
        (known,) = [other for other in motion.phases if other.name == phase.name]
        assert part.times[phase.first] >= motion.times[known.first]
        assert part.times[phase.last] <= motion.times[known.last]
        assert phase.holds == known.holds


# --- stops
# ------------------------------------------------------------------------------------------------


def test_robot_off_its_path_is_braked_where_it_goes() -> None:
    """As a mechanism leads it: from the measured state, beside the path."""
    plan = plan_door()
    motion = plan.trajectory
    size = motion.robot_size
    time = 1.5
    error = np.linspace(-0.01, 0.01, size)
    rate = np.linspace(0.02, -0.01, size)
    stop = brake(plan.scene, motion, time, error=error, error_rate=rate)
    on_path = brake(plan.scene, motion, time)
    np.testing.assert_array_equal(stop.times, on_path.times)
    np.testing.assert_allclose(stop.at(0.0)[:size], motion.at(time)[:size] + error, atol=1e-9)
    expected = motion.velocity(time)[:size] + rate
    np.testing.assert_allclose(stop.velocity(0.0)[:size], expected, atol=1e-9)
    end = float(stop.times[-1])
    np.testing.assert_allclose(stop.velocity(end), 0.0, atol=1e-9)
    # Beside the path by the error, and by its rate times the time of the path that passed
    beside = (stop.at(end) - on_path.at(end))[:size] - error
    passed = beside / rate
    np.testing.assert_allclose(passed, passed[0], rtol=1e-6)
    assert 0.0 < passed[0] < end


@pytest.mark.parametrize("jerk_time", [0.0, 0.1])
def test_stop_brakes_on_the_path_within_the_limits(jerk_time: float) -> None:
    """Those of velocities and accelerations, whether jerks of the motion are limited or not."""
    plan = plan_door(jerk_time)
    motion = plan.trajectory
    dense = motion.at(np.linspace(0.0, motion.times[-1], 20_000))
    for time in np.linspace(0.0, motion.times[-1], 23):
        stop = plan.stop(float(time))
        assert stop.success, f"{time}: {stop.summary()}"
        braking = stop.trajectory
        np.testing.assert_allclose(braking.at(0.0), motion.at(time), atol=1e-9)
        np.testing.assert_allclose(braking.velocity(0.0), motion.velocity(time), atol=1e-9)
        np.testing.assert_array_equal(braking.velocity(braking.times[-1]), 0.0)
        distances = [np.abs(dense - row).max(axis=1).min() for row in braking.positions]
        assert max(distances) < 1e-3
        assert braking.times[-1] <= max(motion.times[-1] - time, 0.0) + 0.01
        assert braking.times[-1] < 1.5


def test_stop_is_no_success_if_something_is_in_the_way() -> None:
    plan = plan_door()
    time = 1.5
    end = plan.stop(time).trajectory.positions[-1]
    there = plan.scene_at(time).with_obstacle("stool", [end[0] + 0.4, end[1], 0.3, 0.0, 0.0, 0.0])
    stop = plan.stop(time, scene=there)
    assert not stop.success
    assert {violation.constraint for violation in stop.report.violations} <= {
        "clearance",
        "penetration",
    }


# --- plans of the rest
# ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("time", [0.5, 1.5, 2.5, 3.2, 4.5, 5.5, 6.5])
def test_rest_of_a_motion_is_planned_from_its_state_and_velocity(time: float) -> None:
    plan = plan_door()
    found = vkc.replan(plan, time, time_limit=30.0)
    assert found.success, found.summary()
    motion = plan.trajectory
    np.testing.assert_allclose(found.trajectory.at(0.0)[:9], motion.at(time)[:9], atol=1e-9)
    begin = found.trajectory.velocity(0.0)[:9]
    np.testing.assert_allclose(begin, motion.velocity(time)[:9], atol=1e-9)
    assert found.trajectory.column("door.hinge")[-1] == pytest.approx(1.2, abs=1e-3)


def test_displaced_door_is_opened_from_the_middle_of_the_motion() -> None:
    plan = plan_door()
    now = plan.scene_at(1.8)
    at = now.objects["door"].placement
    shift = pin.SE3(pin.utils.rotate("z", 0.05), np.array([0.02, 0.03, 0.0]))
    moved = pin.SE3(at.rotation @ shift.rotation, at.translation + shift.translation)
    scene = now.with_placement("door", moved)
    found = vkc.replan(plan, 1.8, scene=scene, time_limit=30.0)
    assert found.success, found.summary()
    assert found.initialization == "given"
    assert found.scene.objects["door"].placement == moved


def measure_slowest(plan: vkc.Plan) -> float:
    """Return the least speed before the hand arrives, in parts of the velocity limits."""
    limits = plan.scene.robot.velocity
    reached = plan.trajectory.times[plan.trajectory.phases[0].last]
    velocities = plan.trajectory.velocity(np.linspace(0.0, 0.8 * reached, 100))[:, : len(limits)]
    return float(np.abs(velocities / limits).max(axis=1).min())


@pytest.mark.parametrize(
    ("time", "shift"),
    [(1.4, (0.05, 0.0)), (1.4, (-0.02, 0.045)), (1.4, (-0.033, -0.038)), (1.2, (0.05, 0.0))],
)
def test_fast_robot_goes_on_to_a_displaced_drawer_without_a_stop(
    time: float, shift: tuple[float, float]
) -> None:
    plan = vkc.plan(vkc.load_scene("drawer"), [vkc.Actuate("drawer", {"slide": 0.3})])
    now = plan.scene_at(time)
    assert np.abs(now.start_velocity / now.robot.velocity).max() > 0.95
    moved = now.objects["drawer"].placement.copy()
    moved.translation[:2] += shift
    found = vkc.replan(plan, time, scene=now.with_placement("drawer", moved), time_limit=30.0)
    assert found.success, found.summary()
    assert measure_slowest(found) > 0.2
    rest = plan.trajectory.times[-1] - time
    assert found.trajectory.times[-1] < 1.1 * rest


def test_robot_that_turns_goes_on_to_a_displaced_drawer_without_a_stop() -> None:
    """Base and arm turn at once: the path by length has no timing, that over planned times has."""
    scene = vkc.load_scene("drawer").with_start(base=[-0.67, -0.085, -2.96])
    plan = vkc.plan(scene, [vkc.Actuate("drawer", {"slide": 0.3})])
    now = plan.scene_at(1.4)
    moved = now.objects["drawer"].placement.copy()
    moved.translation[0] += 0.05
    found = vkc.replan(plan, 1.4, scene=now.with_placement("drawer", moved), time_limit=30.0)
    assert found.success, found.summary()
    assert measure_slowest(found) > 0.03
    # With a stop it takes 2.1 times as long.
    assert found.trajectory.times[-1] < 1.7 * (plan.trajectory.times[-1] - 1.4)


def test_measured_state_is_where_the_new_motion_begins() -> None:
    plan = plan_door()
    state = plan.trajectory.at(1.0)[:9] + 0.01
    velocity = np.zeros(9)
    found = vkc.replan(plan, 1.0, state=state, velocity=velocity, time_limit=30.0)
    assert found.success, found.summary()
    np.testing.assert_allclose(found.trajectory.positions[0, :9], state, atol=1e-9)
    np.testing.assert_array_equal(found.trajectory.velocity(0.0)[:9], velocity)


def test_measured_heading_may_count_other_turns() -> None:
    plan = plan_door()
    state = plan.trajectory.at(1.0)[:9]
    turned = state + 2.0 * np.pi * np.eye(9)[2]
    found = vkc.replan(plan, 1.0, state=turned, time_limit=30.0)
    assert found.success, found.summary()
    np.testing.assert_allclose(found.trajectory.positions[0, :9], state, atol=1e-9)


def test_steps_that_are_over_are_dropped() -> None:
    plan = plan_through_door()
    assert find_remaining_steps(plan, 0.0) == plan.steps
    driving = find_phase_begin(plan, "go")
    assert find_remaining_steps(plan, driving - 1e-3) == plan.steps[1:]
    assert find_remaining_steps(plan, driving + 1e-3) == (vkc.GoTo(1.5, 0.3),)
    found = vkc.replan(plan, driving + 0.3, time_limit=30.0)
    assert found.success, found.summary()
    np.testing.assert_allclose(found.trajectory.positions[-1, :2], [1.5, 0.3], atol=1e-3)


def test_second_replan_of_a_kind_builds_nothing() -> None:
    plan, planner = plan_door(), vkc.Planner()
    vkc.replan(plan, 1.0, planner=planner, time_limit=30.0)
    again = vkc.replan(plan, 2.0, planner=planner, time_limit=30.0)
    assert again.success, again.summary()
    assert again.statistics.build_time == 0.0


@pytest.mark.parametrize(
    ("time", "options", "error"),
    [
        (-0.1, {}, "time"),
        (np.nan, {}, "time"),
        (100.0, {}, "time"),
        ("end", {}, "all steps are over"),
        (1.0, {"state": np.zeros(4)}, "state"),
        (1.0, {"state": np.full(9, np.nan)}, "state"),
        (1.0, {"velocity": np.full(9, 50.0)}, "velocity"),
        (1.0, {"velocity": {"elbow": 0.1}}, "elbow"),
        (1.0, {"scene": "door"}, "scene"),
        (1.0, {"time_limit": -1.0}, "time_limit"),
    ],
)
def test_wrong_arguments_are_named(time: Any, options: dict[str, Any], error: str) -> None:
    plan = plan_door()
    if time == "end":
        time = float(plan.trajectory.times[-1])
    with pytest.raises(InputError, match=error):
        vkc.replan(plan, time, **options)


def test_scene_must_have_the_objects_of_the_plan() -> None:
    plan = plan_door()
    with pytest.raises(UnknownNameError, match="door"):
        vkc.replan(plan, 1.0, scene=vkc.load_scene("drawer"))


def test_only_a_success_is_planned_again_or_stopped() -> None:
    failed = vkc.plan(vkc.load_scene("door"), [vkc.GoTo(2.55, 1.3)], max_evaluations=1000)
    assert not failed.success
    for call in (lambda: vkc.replan(failed, 0.0), lambda: failed.stop(0.0)):
        with pytest.raises(InputError, match="this plan is no success"):
            call()


def test_door_that_is_elsewhere_in_the_hand_is_held_as_measured() -> None:
    """The hand has closed a few millimetres beside the lever."""
    plan = plan_door()
    time = find_phase_begin(plan, "turn") + 0.2
    at = plan.scene.objects["door"].placement
    moved = pin.SE3(at.rotation, at.translation + np.array([0.004, -0.005, 0.0]))
    scene = plan.scene_at(time).with_placement("door", moved)
    found = vkc.replan(plan, time, scene=scene, time_limit=60.0)
    assert found.success, found.summary()
    (hold,) = found.scene.holds
    assert np.linalg.norm(hold.deviation[:3]) == pytest.approx(0.0064, abs=1e-4)
    far = pin.SE3(at.rotation, at.translation + np.array([0.1, 0.0, 0.0]))
    with pytest.raises(InputError, match="100"):
        vkc.replan(plan, time, scene=plan.scene_at(time).with_placement("door", far))
