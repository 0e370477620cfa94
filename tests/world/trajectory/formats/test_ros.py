"""Tests trajectories as ROS JointTrajectory messages."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import operator
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.expected_errors import expect_error
from helpers.trajectory_files import (
    FILES,
    are_equal,
    curved_trajectories,
    trajectories,
    write_text_file,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.interpolate import PchipInterpolator

import vkc_pin as vkc
from vkc_pin.world.trajectory.curve import Curve

COLUMNS = arrays(
    float, st.tuples(st.integers(2, 8), st.integers(3, 5)), elements=st.floats(-10.0, 10.0)
)


def sample_motion(rng: np.random.Generator, n: int = 9) -> tuple[np.ndarray, np.ndarray]:
    return np.cumsum(rng.uniform(0.1, 0.5, n)), np.cumsum(rng.uniform(-0.2, 0.5, (n, 4)), axis=0)


def make_motion(times: np.ndarray, positions: np.ndarray) -> vkc.Trajectory:
    """Return a motion without a curve of any coordinates, at least three."""
    names = ("base_x", "base_y", "base_yaw", *"abcdefgh")[: positions.shape[1]]
    phases = (vkc.PhaseSpan("drive", 0, len(times) - 1),)
    return vkc.Trajectory(names, times, positions, phases, positions.shape[1])


def stack(message: dict[str, Any], key: str) -> np.ndarray:
    return np.array([point[key] for point in message["points"]])


def read_times(message: dict[str, Any]) -> np.ndarray:
    since = [point["time_from_start"] for point in message["points"]]
    return np.array([one["sec"] + 1e-9 * one["nanosec"] for one in since])


def test_velocities_match_scipys_monotone_cubic() -> None:
    times, positions = sample_motion(np.random.default_rng(0))
    positions[3:6, 0] = positions[3, 0]  # at rest
    message = make_motion(times, positions).to_ros()
    expected = PchipInterpolator(times, positions).derivative()(times)
    velocities = stack(message, "velocities")
    np.testing.assert_allclose(velocities[1:-1], expected[1:-1], atol=1e-6)
    assert (velocities[[0, -1]] == 0.0).all()


@given(COLUMNS, st.integers(0, 1000), st.none() | st.floats(0.5, 20.0))
def test_coordinates_stay_between_their_waypoints(
    positions: np.ndarray, seed: int, rate: float | None
) -> None:
    rng = np.random.default_rng(seed)
    times = np.cumsum([0.0, *rng.uniform(0.01, 2.0, len(positions) - 1)])
    motion = make_motion(times, positions)
    received = vkc.Trajectory.from_ros(motion.to_ros(rate=rate), like=motion)
    np.testing.assert_allclose(received.positions, positions, atol=1e-12)
    lowest, highest = received.ranges()
    ends = np.sort([positions[:-1], positions[1:]], axis=0)
    assert (lowest >= ends[0] - 1e-7).all()  # times of messages are rounded to 1 ns
    assert (highest <= ends[1] + 1e-7).all()


def test_motion_of_an_arm_alone_is_rejected() -> None:
    points = [{"positions": [k] * 4, "time_from_start": {"sec": k, "nanosec": 0}} for k in (0, 1)]
    message = {"joint_names": list("abcd"), "points": points}
    with pytest.raises(vkc.InputError, match="joint_names: no base coordinates"):
        vkc.Trajectory.from_ros(message)
    assert vkc.Trajectory.from_ros(message, robot_size=4).robot_size == 4


@FILES
@given(trajectory=trajectories(largest=1e6))
def test_ros_round_trip_is_exact_to_a_nanosecond(trajectory: vkc.Trajectory) -> None:
    """A motion without a curve is lines, which need no velocities."""
    message = json.loads(json.dumps(trajectory.to_ros(joints="all", derivatives=0)))
    back, times = vkc.Trajectory.from_ros(message, like=trajectory), trajectory.times
    np.testing.assert_allclose(back.times, times - times[0], rtol=0.0, atol=1e-9)
    assert {**back.to_dict(), "times": 0} == {**trajectory.to_dict(), "times": 0}


RATES = st.none() | st.floats(0.5, 200.0)


@FILES
@given(curved_trajectories(), RATES, st.integers(0, 2))
def test_every_message_is_the_same_motion(
    trajectory: vkc.Trajectory, rate: float | None, derivatives: int
) -> None:
    """Lines are off by at most a·h²/8, quintics by 0.02·J·h² for a jump J at each end."""
    curve = trajectory.curve
    assert curve is not None
    message = trajectory.to_ros(rate=rate, derivatives=derivatives)
    received = vkc.Trajectory.from_ros(json.loads(json.dumps(message)), like=trajectory)
    reached = received.at(trajectory.times)
    np.testing.assert_allclose(reached, trajectory.positions, atol=1e-8)
    _, largest = curve.compute_max_rates()
    _, jumps = curve.compute_jerks()
    spacing = np.diff(read_times(message))
    accepted = 2e-6  # 1e-6 of quintics, and times rounded to 1 ns
    if derivatives == 0:
        accepted += (spacing.max() ** 2 * largest.max()) / 8.0
    if derivatives == 2:
        accepted += 0.04 * jumps[1:-1].max(initial=0.0) * spacing.max() ** 2
        # Where nothing should move, nothing does.
        still = ~np.diff(curve.positions, axis=0).any(axis=1)
        for begin, end in zip(curve.times[:-1][still], curve.times[1:][still], strict=True):
            assert np.ptp(received.at(np.linspace(begin, end, 50)), axis=0).max() < 1e-8
    at = np.linspace(0.0, trajectory.times[-1], 1000)
    np.testing.assert_allclose(received.at(at), trajectory.at(at), atol=accepted)
    if derivatives == 1:
        assert received.curve is not None
        fastest, strongest = received.curve.compute_max_rates()
        speeds, _ = curve.compute_max_rates()
        assert (fastest.max(axis=0) <= speeds.max(axis=0) + 1e-6).all()
        assert (strongest.max(axis=0) <= largest.max(axis=0) * (1.0 + 1e-6) + 1e-6).all()


@FILES
@given(curved_trajectories(), RATES)
def test_files_are_the_same_motion(trajectory: vkc.Trajectory, rate: float | None) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "motion"
        assert are_equal(vkc.Trajectory.from_csv(trajectory.to_csv(path)), trajectory)
        assert are_equal(vkc.Trajectory.from_json(trajectory.to_json(path)), trajectory)
        path.write_text(json.dumps(trajectory.to_ros(rate=rate)))
        received = vkc.Trajectory.from_ros(path, like=trajectory)
    at = np.linspace(0.0, trajectory.times[-1], 1000)
    np.testing.assert_allclose(received.at(at), trajectory.at(at), atol=1e-6)


@FILES
@given(curved_trajectories(), st.floats(0.5, 1000.0))
def test_points_at_a_rate_are_half_a_period_apart(trajectory: vkc.Trajectory, rate: float) -> None:
    """They are nearer only where the motion's own knots are."""
    assert trajectory.curve is not None
    times = read_times(trajectory.to_ros(rate=rate))
    spacing, own = np.diff(times), np.diff(trajectory.curve.times)
    assert spacing.max() <= 1.0 / rate + 2e-6
    assert spacing.min() >= min(0.5 / rate, own.min()) - 2e-9
    distances = np.abs(times[:, None] - trajectory.curve.times).min(axis=0)
    assert distances.max() <= 1e-9


def command(message: dict[str, Any], time: float) -> np.ndarray:
    """Return the positions that ros2_controllers 4.42.1 commands, from its polynomials."""
    times = read_times(message)
    k = int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, len(times) - 2))
    one, two = message["points"][k : k + 2]
    duration, t = times[k + 1] - times[k], time - times[k]
    known = [key for key in ("velocities", "accelerations") if one[key] and two[key]]
    keys = ["positions", *known] if known[:1] == ["velocities"] else ["positions"]
    # The polynomial with these derivatives at both ends.
    count = 2 * len(keys)
    equations, values = np.zeros((count, count)), []
    for row, (when, point, order) in enumerate(
        (when, point, order)
        for when, point in ((0.0, one), (duration, two))
        for order in range(len(keys))
    ):
        for power in range(order, count):
            factor = math.perm(power, order)
            equations[row, power] = factor * when ** (power - order)
        values.append(point[keys[order]])
    coefficients = np.linalg.solve(equations, np.array(values))
    return (t ** np.arange(count)) @ coefficients


@given(st.data())
@settings(deadline=None)
def test_messages_are_read_as_controllers_interpolate_them(data: st.DataObject) -> None:
    """Each segment is a line, a cubic or a quintic, depending on both its points."""
    count = data.draw(st.integers(2, 6))
    rng = np.random.default_rng(data.draw(st.integers(0, 10_000)))
    nanos = np.cumsum(rng.integers(20_000_000, 900_000_000, count))
    kinds = data.draw(st.lists(st.integers(0, 2), min_size=count, max_size=count))
    points = [
        {
            "positions": rng.uniform(-1.0, 1.0, 3).tolist(),
            "velocities": rng.uniform(-1.0, 1.0, 3).tolist() if kind else [],
            "accelerations": rng.uniform(-5.0, 5.0, 3).tolist() if kind == 2 else [],
            "time_from_start": dict(zip(("sec", "nanosec"), divmod(nano, 10**9), strict=True)),
        }
        for kind, nano in zip(kinds, nanos.tolist(), strict=True)
    ]
    message = {"joint_names": ["base_x", "base_y", "base_yaw"], "points": points}
    received = vkc.Trajectory.from_ros(message)
    at = rng.uniform(nanos[0] + 2000, nanos[-1] - 2000, 60) * 1e-9
    expected = np.array([command(message, time) for time in at])
    np.testing.assert_allclose(received.at(at), expected, atol=3e-6)
    has_curve = any(one and two for one, two in itertools.pairwise(kinds))
    assert (received.curve is not None) == has_curve


def test_quintics_keep_their_accelerations() -> None:
    """Validation compares accelerations with limits: an error of 1e-3 is accepted."""
    point: dict[str, Any] = {"velocities": [0.0] * 3, "accelerations": [0.0] * 3}
    points = [
        {**point, "positions": [end] * 3, "time_from_start": {"sec": k, "nanosec": 0}}
        for k, end in enumerate((0.0, 1.0))
    ]
    message = {"joint_names": ["base_x", "base_y", "base_yaw"], "points": points}
    curve = vkc.Trajectory.from_ros(message).curve
    assert curve is not None
    fastest, strongest = curve.compute_max_rates()
    # The smoothest step, 10s³ − 15s⁴ + 6s⁵, has v ≤ 15/8 and a ≤ 10/√3.
    assert fastest.max() == pytest.approx(15.0 / 8.0, rel=1e-4)
    assert strongest.max() == pytest.approx(10.0 / math.sqrt(3.0), rel=1e-3)


@pytest.mark.parametrize("lacking", ["velocities", "both", "end"])
def test_velocities_are_not_dropped(door_plan: vkc.Plan, lacking: str) -> None:
    """One point without velocities makes two segments lines, and nothing else."""
    motion = door_plan.trajectory
    message = motion.to_ros(joints="all", derivatives=2 if lacking == "both" else 1)
    number = len(message["points"]) - 1 if lacking == "end" else 5
    message["points"][number].update(velocities=[], accelerations=[])
    received = vkc.Trajectory.from_ros(message, like=motion)
    times = read_times(message)
    before = np.linspace(0.0, times[number - 1], 200)
    accepted = 3e-4 if lacking == "both" else 1e-7
    np.testing.assert_allclose(received.at(before), motion.at(before), atol=accepted)
    middle = (times[number] + times[number - 1]) / 2.0
    ends = [message["points"][k]["positions"] for k in (number - 1, number)]
    np.testing.assert_allclose(received.at(middle), np.mean(ends, axis=0), atol=1e-7)
    report = vkc.validate(door_plan.scene, door_plan.steps, received, door_plan.options)
    assert "acceleration" in {violation.constraint for violation in report.violations}


def test_accelerations_of_jerk_limited_motions_are_valid() -> None:
    """Without jumps of accelerations, the quintics of a controller are the planned cubics."""
    scene, options = vkc.load_scene("door"), vkc.Options(jerk_time=0.05)
    plan = vkc.plan(scene, [vkc.GoTo(0.0, 0.0, 0.0)], options=options)
    message = plan.to_ros(joints="all", derivatives=2)
    received = vkc.Trajectory.from_ros(message, like=plan.trajectory)
    at = np.linspace(0.0, received.times[-1], 1000)
    np.testing.assert_allclose(received.at(at), plan.trajectory.at(at), atol=1e-6)
    report = vkc.validate(scene, plan.steps, received, options)
    assert report.ok, report.lines()


@pytest.mark.parametrize("order", ["alphabetical", "reversed", "rotated"])
def test_coordinates_are_sorted_by_name(door_plan: vkc.Plan, order: str) -> None:
    message = door_plan.to_ros(joints="all")
    names = message["joint_names"]
    count = len(names)
    orders = {
        "alphabetical": sorted(range(count), key=lambda k: names[k]),
        "reversed": list(range(count))[::-1],
        "rotated": [*range(3, count), 0, 1, 2],
    }
    foreign = orders[order]
    message["joint_names"] = [names[k] for k in foreign]
    for point in message["points"]:
        for key in ("positions", "velocities"):
            point[key] = [point[key][k] for k in foreign]
    expected = vkc.Trajectory.from_ros(door_plan.to_ros(joints="all"), like=door_plan.trajectory)
    assert are_equal(vkc.Trajectory.from_ros(message, like=door_plan.trajectory), expected)
    with expect_error("joint_names: (no base coordinates|not in order)"):
        vkc.Trajectory.from_ros(message)


def test_objects_before_joints_of_the_robot_are_rejected(tmp_path: Path) -> None:
    """They would else end the robot's coordinates."""
    table = "time,base_x,base_y,base_yaw,door.hinge,elbow\n0,0,0,0,0,0\n1,0,0,0,1,1\n"
    path = write_text_file(tmp_path / "motion.csv", table)
    with expect_error("motion.csv:1: not in order .expected .*robot before .*got 'elbow'"):
        vkc.Trajectory.from_csv(path)
    assert vkc.Trajectory.from_csv(path, robot_size=5).robot_size == 5


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


def test_motions_too_long_for_a_message_are_rejected() -> None:
    """Seconds are signed integers of 32 bits."""
    rows = np.array([np.zeros(3), np.ones(3)])
    last = 2.0**31 - 1.0
    message = make_motion(np.array([5.0, last + 5.0]), rows).to_ros()
    assert message["points"][-1]["time_from_start"] == {"sec": int(last), "nanosec": 0}
    with expect_error("motion: too long .*less than 2.31"):
        make_motion(np.array([5.0, last + 7.0]), rows).to_ros()


@pytest.mark.parametrize("rate", [1.0, 25.0])
@pytest.mark.parametrize("derivatives", [0, 1, 2])
def test_rests_keep_their_duration_at_any_rate(rate: float, derivatives: int) -> None:
    """There are points at both ends of every rest."""
    knots = np.array([0.0, 1.1, 1.4, 2.0, 2.00002, 3.3])
    waypoints = np.array([0.0, 1.0, 1.0, 2.0, 2.0, 3.0])[:, None] * np.ones(3)
    curve = Curve(knots, waypoints, np.zeros((6, 3)))
    names, phases = ("base_x", "base_y", "base_yaw"), (vkc.PhaseSpan("drive", 0, 5),)
    motion = vkc.Trajectory(names, knots, waypoints, phases, 3, curve)
    message = motion.to_ros(rate=rate, derivatives=derivatives)
    received = vkc.Trajectory.from_ros(message)
    sample_times = np.linspace(1.1, 1.4, 20)
    np.testing.assert_allclose(received.at(sample_times), 1.0, atol=1e-12)
    apart = np.abs(read_times(message)[:, None] - knots).min(axis=0)
    assert apart.max() <= 1e-9


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
            r"points\[2\].positions\[4\]: not a number .expected a number up to 1e.12, got 'far'",
        ),
        (
            lambda m: operator.setitem(m["points"][2]["positions"], 4, float("nan")),
            r"points\[2\].positions\[4\]: not a number .expected a number up to 1e.12, got nan",
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
            r"points\[2\].time_from_start: times do not increase .expected more than 5\.\d+ s",
        ),
        (
            lambda m: m["points"][2]["time_from_start"].update(sec=10**400),
            r"points\[2\].time_from_start.sec: out of range .expected less than 4294967296, got an",
        ),
        (
            lambda m: m["points"][3].update(velocities={"a": 1.0}),
            r"points\[3\].velocities: wrong type of value .expected a list",
        ),
        (
            lambda m: m["points"][3].update(velocities=[1.0]),
            r"points\[3\].velocities: wrong number of values .expected 9, got 1",
        ),
        (
            lambda m: m["points"][3].update(accelerations=[math.inf] * 9),
            r"points\[3\].accelerations\[0\]: not a number .expected a number up to 1e.12, got inf",
        ),
        (
            lambda m: [p.update(velocities=[], accelerations=[0.0] * 9) for p in m["points"][3:5]],
            r"points\[4\].velocities: accelerations without velocities: ros2_controllers commands",
        ),
        (
            lambda m: m["joint_names"].__setitem__(4, "base_x"),
            r"joint_names\[4\]: a name occurs twice .got base_x",
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


def test_names_that_do_not_fit_are_rejected(plan: vkc.Plan) -> None:
    message = plan.to_ros()
    known = message["joint_names"][3]
    message["joint_names"][3] = f"left_{known}"
    expected = rf"joint_names\[3\]: there is no coordinate 'left_{known}'; did you mean '{known}'"
    with expect_error(expected):
        vkc.Trajectory.from_ros(message, like=plan.trajectory)
    with expect_error(f"joint_names: coordinates of the robot are missing .expected {known}"):
        vkc.Trajectory.from_ros(plan.to_ros(joints="base"), like=plan.trajectory)


@pytest.mark.parametrize("kind", ["slower", "delayed", "stopped", "ends"])
def test_messages_with_other_times_than_phases_are_rejected(
    door_plan: vkc.Plan, tmp_path: Path, kind: str
) -> None:
    """Otherwise grasps would begin between the phases of the motion."""
    motion = door_plan.trajectory
    message = motion.to_ros(joints="all")
    times = read_times(message)
    if kind == "ends":
        message["points"] = [message["points"][k] for k in (0, -1)]
    elif kind == "stopped":
        message["points"] = message["points"][:40]
    else:
        changed = 2.0 * times if kind == "slower" else times + 0.7
        for point, time in zip(message["points"], changed.tolist(), strict=True):
            sec, nanosec = divmod(round(time * 1e9), 10**9)
            point["time_from_start"] = {"sec": sec, "nanosec": nanosec}
    expected = f"points: there are no points at the times.*{motion.times[-1]:.3f}"
    with expect_error(expected):
        vkc.Trajectory.from_ros(message, like=motion)
    file = write_text_file(tmp_path / "sent.json", json.dumps(message))
    with expect_error(f"sent.json: {expected}"):
        vkc.Trajectory.from_ros(file, like=motion)


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


@pytest.mark.parametrize("rate", [5.0, 50.0, 300.0])
def test_exported_motions_can_be_validated(door_plan: vkc.Plan, rate: float) -> None:
    message, motion = door_plan.to_ros(joints="all", rate=rate), door_plan.trajectory
    received = vkc.Trajectory.from_ros(message, like=motion)
    assert [phase.name for phase in received.phases] == [phase.name for phase in motion.phases]
    report = vkc.validate(door_plan.scene, door_plan.steps, received, door_plan.options)
    assert report.ok, report.lines()


def test_motions_without_a_curve_become_smooth(plan: vkc.Plan) -> None:
    """Lines are their own motion; cubics pass through the same waypoints."""
    motion = plan.trajectory
    lines = vkc.Trajectory.from_ros(motion.to_ros(joints="all", smooth=False), like=motion)
    dense = motion.to_ros(joints="all", smooth=False, rate=50.0)
    at = np.linspace(0.0, motion.times[-1], 500)
    for received in (lines, vkc.Trajectory.from_ros(dense, like=motion)):
        assert received.curve is None
        np.testing.assert_allclose(received.at(at), motion.at(at), atol=1e-7)
    cubics = vkc.Trajectory.from_ros(motion.to_ros(joints="all"), like=motion)
    assert cubics.curve is not None
    np.testing.assert_allclose(cubics.positions, motion.positions, atol=1e-8)
