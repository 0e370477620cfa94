"""Tests trajectories as ROS JointTrajectory messages."""

from __future__ import annotations

import dataclasses
import json
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
    velocities, _ = estimate_rates(times, positions)
    np.testing.assert_allclose(
        velocities[1:-1], PchipInterpolator(times, positions).derivative()(times)[1:-1], atol=1e-12
    )
    assert (velocities[[0, -1]] == 0.0).all()


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
    assert (position >= np.minimum(positions[at], positions[at + 1])).all()
    assert (position <= np.maximum(positions[at], positions[at + 1])).all()


def test_motion_of_an_arm_alone_is_rejected() -> None:
    points = [{"positions": [k] * 4, "time_from_start": {"sec": k, "nanosec": 0}} for k in (0, 1)]
    message = {"joint_names": list("abcd"), "points": points}
    with pytest.raises(vkc.InputError, match="joint_names: no base coordinates"):
        Trajectory.from_ros(message)
    assert Trajectory.from_ros(message, robot_size=4).robot_size == 4


def test_resting_coordinates_stay_at_rest() -> None:
    times = np.array([0.0, 1.0, 2.0, 3.0, 4.0])
    positions = np.array([[0.0], [1.0], [1.0], [1.0], [0.5]])
    velocities, accelerations = estimate_rates(times, positions)
    assert (velocities == 0.0).all()
    assert (accelerations == 0.0).all(), "the direction reverses at rest"
    position, velocity, acceleration = evaluate_cubics(
        times, positions, velocities, np.linspace(1.0, 2.99, 20)
    )
    assert (position == 1.0).all()
    assert (velocity == 0.0).all()
    assert (acceleration == 0.0).all()


@FILES
@given(trajectory=trajectories(largest=1e6))
def test_ros_round_trip_is_exact_to_a_nanosecond(trajectory: vkc.Trajectory) -> None:
    back = vkc.Trajectory.from_ros(
        json.loads(json.dumps(trajectory.to_ros(joints="all"))), like=trajectory
    )
    np.testing.assert_allclose(
        back.times, trajectory.times - trajectory.times[0], rtol=0.0, atol=1e-9
    )
    assert {**back.to_dict(), "times": 0} == {**trajectory.to_dict(), "times": 0}


def test_a_message_has_the_fields_of_a_joint_trajectory(plan: vkc.Plan) -> None:
    message = plan.to_ros(frame="map", stamp=1.5)
    assert json.loads(json.dumps(message)) == message, "plain data"
    assert set(message) == {"header", "joint_names", "points"}
    assert message["header"] == {"stamp": {"sec": 1, "nanosec": 500_000_000}, "frame_id": "map"}
    assert message["joint_names"] == list(plan.trajectory.names[:9]), "coordinates with motors"
    for point, moment in zip(message["points"], plan.trajectory.times, strict=True):
        assert set(point) == {
            "positions",
            "velocities",
            "accelerations",
            "effort",
            "time_from_start",
        }
        assert {len(point[key]) for key in ("positions", "velocities", "accelerations")} == {9}
        assert point["effort"] == []
        since = point["time_from_start"]
        assert type(since["sec"]) is type(since["nanosec"]) is int
        assert 0 <= since["nanosec"] < 1_000_000_000
        assert since["sec"] + 1e-9 * since["nanosec"] == pytest.approx(moment, abs=1e-9)
    for end in (message["points"][0], message["points"][-1]):
        assert set(end["velocities"]) == {0.0}


def test_number_of_points_is_limited(plan: vkc.Plan) -> None:
    duration = float(np.ptp(plan.trajectory.times))
    with pytest.raises(vkc.InputError, match="too many points") as caught:
        plan.to_ros(rate=1.1e6 / duration / len(plan.scene.start))
    assert caught.value.field == "rate"
    assert f"{1e6 // len(plan.scene.start) / duration:.4g} a second" in str(caught.value)


@pytest.mark.parametrize("rate", [1.0, 25.0])
def test_rests_keep_their_duration_at_any_rate(rate: float) -> None:
    """There are points at both ends of every rest."""
    knots = np.array([0.0, 1.1, 1.4, 2.0, 2.00002, 3.3])
    waypoints = np.array([0.0, 1.0, 1.0, 2.0, 2.0, 3.0])[:, None] * np.ones(3)
    curve = Curve(knots, waypoints, np.zeros((6, 3)))
    motion = vkc.Trajectory(
        ("base_x", "base_y", "base_yaw"),
        knots,
        waypoints,
        (vkc.PhaseSpan("drive", 0, 5),),
        3,
        curve,
    )
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


def replace_value(message: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    """Return a copy with another value at a path such as "points/0/positions"; None removes it."""
    copy = json.loads(json.dumps(message))
    *path_parts, last = [int(part) if part.isdigit() else part for part in path.split("/")]
    inner = copy
    for part in path_parts:
        inner = inner[part]
    if value is None:
        del inner[last]
    else:
        inner[last] = value
    return copy


@pytest.mark.parametrize(
    ("path", "value", "expected"),
    [
        ("joint_names", None, "joint_names: this is missing"),
        ("joint_names", "x", "joint_names: wrong type of value .expected a list, got 'x'"),
        ("points/2", 3, r"points\[2\].positions: this is missing"),
        (
            "points/2/positions",
            [1.0],
            r"points\[2\].positions: wrong number of values .expected 9, got 1",
        ),
        (
            "points/2/positions/4",
            "far",
            r"points\[2\].positions\[4\]: not a number .expected a number, got 'far'",
        ),
        ("points/2/positions/4", float("nan"), r"Trajectory.positions\[2, 4\]: not finite"),
        (
            "points/1/time_from_start/sec",
            0.5,
            r"points\[1\].time_from_start.sec: wrong type of value .expected a whole number",
        ),
        (
            "points/1/time_from_start/nanosec",
            None,
            r"points\[1\].time_from_start.nanosec: this is missing",
        ),
        ("points/1/time_from_start/sec", 5, "Trajectory.times: times do not increase"),
    ],
)
def test_invalid_messages_are_rejected(
    plan: vkc.Plan, tmp_path: Path, path: str, value: Any, expected: str
) -> None:
    message = replace_value(plan.to_ros(), path, value)
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


@pytest.mark.parametrize("smooth", [True, False])
def test_exported_motions_can_be_validated(door_plan: vkc.Plan, smooth: bool) -> None:
    received = vkc.Trajectory.from_ros(
        door_plan.to_ros(joints="all", rate=50.0, smooth=smooth), like=door_plan.trajectory
    )
    assert [phase.name for phase in received.phases] == [
        phase.name for phase in door_plan.trajectory.phases
    ]
    options = dataclasses.replace(door_plan.options, dist_safe=0.01)  # the margin between waypoints
    report = vkc.validate(door_plan.scene, door_plan.steps, received, options)
    expected = (
        {"acceleration", "closure"} if smooth else {"acceleration"}
    )  # the velocity jumps between linear pieces
    assert {violation.constraint for violation in report.violations} <= expected, report.lines()
    assert report.closure_error < (2e-3 if smooth else 1e-3)
    assert np.abs(received.positions - door_plan.trajectory.at(received.times)).max() < (
        0.02 if smooth else 1e-9
    )
