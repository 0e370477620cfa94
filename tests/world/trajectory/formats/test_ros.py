"""Tests trajectories as ROS JointTrajectory messages."""

from __future__ import annotations

import dataclasses
import json
import operator
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.expected_errors import expect_error
from helpers.trajectory_files import FILES, trajectories, write_text_file
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.interpolate import PchipInterpolator

import vkc_pin as vkc
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.formats.ros import estimate_rates, evaluate_cubics

COLUMNS = arrays(
    float, st.tuples(st.integers(2, 8), st.integers(1, 3)), elements=st.floats(-10.0, 10.0)
)


def sample_motion(rng: np.random.Generator, n: int = 9) -> tuple[np.ndarray, np.ndarray]:
    return np.cumsum(rng.uniform(0.1, 0.5, n)), np.cumsum(rng.uniform(-0.2, 0.5, (n, 4)), axis=0)


def test_velocities_match_scipys_monotone_cubic() -> None:
    times, positions = sample_motion(np.random.default_rng(0))
    positions[3:6, 0] = positions[3, 0]  # at rest
    velocities, accelerations = estimate_rates(times, positions)
    expected = PchipInterpolator(times, positions).derivative()(times)
    np.testing.assert_allclose(velocities[1:-1], expected[1:-1], atol=1e-12)
    assert (velocities[[0, -1]] == 0.0).all()
    assert accelerations[4, 0] == 0.0


@given(COLUMNS, st.integers(0, 1000))
def test_coordinates_stay_between_their_waypoints(positions: np.ndarray, seed: int) -> None:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.01, 2.0, len(positions)))
    velocities, accelerations = estimate_rates(times, positions)
    assert np.isfinite(velocities).all()
    assert np.isfinite(accelerations).all()
    sample_times = np.sort(rng.uniform(times[0], times[-1], 50))
    position, _, _ = evaluate_cubics(times, positions, velocities, sample_times)
    at = np.clip(np.searchsorted(times, sample_times, side="right") - 1, 0, len(times) - 2)
    ends = np.sort([positions[at], positions[at + 1]], axis=0)
    assert ((ends[0] <= position) & (position <= ends[1])).all()


def test_motion_of_an_arm_alone_is_rejected() -> None:
    points = [{"positions": [k] * 4, "time_from_start": {"sec": k, "nanosec": 0}} for k in (0, 1)]
    message = {"joint_names": list("abcd"), "points": points}
    with pytest.raises(vkc.InputError, match="joint_names: no base coordinates"):
        vkc.Trajectory.from_ros(message)
    assert vkc.Trajectory.from_ros(message, robot_size=4).robot_size == 4


@FILES
@given(trajectory=trajectories(largest=1e6))
def test_ros_round_trip_is_exact_to_a_nanosecond(trajectory: vkc.Trajectory) -> None:
    message = json.loads(json.dumps(trajectory.to_ros(joints="all")))
    back, times = vkc.Trajectory.from_ros(message, like=trajectory), trajectory.times
    np.testing.assert_allclose(back.times, times - times[0], rtol=0.0, atol=1e-9)
    assert {**back.to_dict(), "times": 0} == {**trajectory.to_dict(), "times": 0}


def test_a_message_has_all_motors_and_the_times_of_waypoints(plan: vkc.Plan) -> None:
    """The tests of ROS bags compare all fields with those of the message types."""
    message = plan.to_ros()
    assert json.loads(json.dumps(message)) == message, "plain data"
    assert message["joint_names"] == list(plan.trajectory.names[:9])
    for point, moment in zip(message["points"], plan.trajectory.times, strict=True):
        since = point["time_from_start"]
        assert 0 <= since["nanosec"] < 1_000_000_000
        assert since["sec"] + 1e-9 * since["nanosec"] == pytest.approx(moment, abs=1e-9)
    for end in (message["points"][0], message["points"][-1]):
        assert set(end["velocities"]) == {0.0}


def test_number_of_points_is_limited(plan: vkc.Plan) -> None:
    duration = float(np.ptp(plan.trajectory.times))
    highest = f"{1e6 // len(plan.scene.start) / duration:.4g} a second"
    with expect_error(f"rate: too many points.*{re.escape(highest)}"):
        plan.to_ros(rate=1.1e6 / duration / len(plan.scene.start))


@pytest.mark.parametrize("rate", [1.0, 25.0])
def test_rests_keep_their_duration_at_any_rate(rate: float) -> None:
    """There are points at both ends of every rest."""
    knots = np.array([0.0, 1.1, 1.4, 2.0, 2.00002, 3.3])
    waypoints = np.array([0.0, 1.0, 1.0, 2.0, 2.0, 3.0])[:, None] * np.ones(3)
    curve = Curve(knots, waypoints, np.zeros((6, 3)))
    names, phases = ("base_x", "base_y", "base_yaw"), (vkc.PhaseSpan("drive", 0, 5),)
    motion = vkc.Trajectory(names, knots, waypoints, phases, 3, curve)
    received = vkc.Trajectory.from_ros(motion.to_ros(rate=rate))
    even = np.append(np.arange(np.ceil(3.3 * rate - 1e-6)) / rate, 3.3)
    even = even[(np.abs(even[:, None] - knots[1:5]) > 1e-4).all(axis=1)]
    np.testing.assert_allclose(received.times, np.sort([*even, *knots[1:5]]), atol=1e-8)
    sample_times = np.linspace(1.1, 1.4, 20)
    np.testing.assert_allclose(received.at(sample_times), 1.0, atol=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rate": 0.0}, "rate: out of range"),
        ({"derivatives": 3}, "derivatives: out of range"),
        ({"stamp": -1.0}, "stamp: out of range"),
        ({"joints": []}, "joints: no joints"),
    ],
)
def test_invalid_options_are_rejected(
    plan: vkc.Plan, options: dict[str, Any], message: str
) -> None:
    with expect_error(message):
        plan.to_ros(**options)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda m: m.pop("joint_names"), "joint_names: this is missing"),
        (
            lambda m: m.update(joint_names="x"),
            "joint_names: wrong type of value .expected a list, got 'x'",
        ),
        (lambda m: m["points"].insert(2, 3), r"points\[2\].positions: this is missing"),
        (
            lambda m: m["points"][2].update(positions=[1.0]),
            r"points\[2\].positions: wrong number of values .expected 9, got 1",
        ),
        (
            lambda m: operator.setitem(m["points"][2]["positions"], 4, "far"),
            r"points\[2\].positions\[4\]: not a number .expected a number, got 'far'",
        ),
        (
            lambda m: operator.setitem(m["points"][2]["positions"], 4, float("nan")),
            r"Trajectory.positions\[2, 4\]: not finite",
        ),
        (
            lambda m: m["points"][1]["time_from_start"].update(sec=0.5),
            r"points\[1\].time_from_start.sec: wrong type of value .expected a whole number",
        ),
        (
            lambda m: m["points"][1]["time_from_start"].pop("nanosec"),
            r"points\[1\].time_from_start.nanosec: this is missing",
        ),
        (
            lambda m: m["points"][1]["time_from_start"].update(sec=5),
            "Trajectory.times: times do not increase",
        ),
    ],
)
def test_invalid_messages_are_rejected(
    plan: vkc.Plan, tmp_path: Path, change: Callable[[dict[str, Any]], Any], expected: str
) -> None:
    message = json.loads(json.dumps(plan.to_ros()))
    change(message)
    with expect_error(f"^{expected}"):
        vkc.Trajectory.from_ros(message)
    with expect_error(f"bad.json: {expected}"):
        vkc.Trajectory.from_ros(write_text_file(tmp_path / "bad.json", json.dumps(message)))


def test_exported_knots_describe_the_same_motion(door_plan: vkc.Plan) -> None:
    """Clearances hold at waypoints, so knots between them must not become waypoints."""
    motion = door_plan.trajectory
    received = vkc.Trajectory.from_ros(motion.to_ros(joints="all"), like=motion)
    assert len(motion.times) < len(motion.curve.times)
    np.testing.assert_allclose(received.times, motion.times - motion.times[0], atol=1e-8)
    assert [vars(phase) for phase in received.phases] == [vars(phase) for phase in motion.phases]
    sample_times = np.linspace(0.0, received.times[-1], 500)
    np.testing.assert_allclose(received.at(sample_times), motion.at(sample_times), atol=1e-7)
    tight = dataclasses.replace(door_plan.options, dist_safe=door_plan.report.clearance - 1e-5)
    assert vkc.validate(door_plan.scene, door_plan.steps, received, tight).ok


def test_exported_knots_keep_jerk_limits() -> None:
    """Knots are only 35 µs apart, where rounding a time to 1 ns changes accelerations by 1 %."""
    scene, options = vkc.load_scene("door"), vkc.Options(jerk_time=0.005)
    plan = vkc.plan(scene, [vkc.GoTo(0.0, 0.0, 0.0)] * 2, options=options)
    assert plan.success
    received = vkc.Trajectory.from_ros(plan.to_ros(joints="all"), like=plan.trajectory)
    report = vkc.validate(scene, plan.steps, received, options)
    assert report.ok, report.lines()


@pytest.mark.parametrize("smooth", [True, False])
def test_exported_motions_can_be_validated(door_plan: vkc.Plan, smooth: bool) -> None:
    message, motion = door_plan.to_ros(joints="all", rate=50.0, smooth=smooth), door_plan.trajectory
    received = vkc.Trajectory.from_ros(message, like=motion)
    assert [phase.name for phase in received.phases] == [phase.name for phase in motion.phases]
    options = dataclasses.replace(door_plan.options, dist_safe=0.01)  # the margin between waypoints
    report = vkc.validate(door_plan.scene, door_plan.steps, received, options)
    # The velocity jumps between linear pieces.
    expected = {"acceleration", "closure"} if smooth else {"acceleration"}
    assert {violation.constraint for violation in report.violations} <= expected, report.lines()
    assert report.closure_error < (2e-3 if smooth else 1e-3)
    deviation = np.abs(received.positions - motion.at(received.times)).max()
    assert deviation < (0.02 if smooth else 1e-9)
