from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.fake_plan import fake_plan
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin import cli
from vkc_pin.motion.trajectory import PhaseSpan, Trajectory
from vkc_pin.motion.world import units_of
from vkc_pin.planning.plan import Plan
from vkc_pin.scene.hold import Hold

FILES = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60, deadline=None)
ROBOT = ("base_x", "base_y", "base_yaw", "lift", "elbow")


@st.composite
def trajectories(draw: st.DrawFn, largest: float | None = None) -> Trajectory:
    """Return trajectories whose robot has up to five coordinates, with things held and carried through others."""
    robot, things = draw(st.integers(3, 5)), draw(st.lists(st.sampled_from("abcde"), max_size=4, unique=True))
    names = (*ROBOT[:robot], *(f"{name}.joint" for name in things))
    steps = draw(st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=8))
    times = draw(st.floats(-1e3, 1e3)) + np.cumsum([0.0, *steps])
    numbers = st.floats(allow_nan=False, allow_infinity=False) if largest is None else st.floats(-largest, largest)
    rows = draw(st.lists(st.lists(numbers, min_size=len(names), max_size=len(names)), min_size=len(times), max_size=len(times)))
    cuts = sorted(draw(st.sets(st.integers(1, len(steps)))) | {len(steps)})
    label, phases, first = st.text(st.characters(exclude_categories=["Cs"]), max_size=6), [], 0
    name, link = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="."), max_size=6), label.filter(bool)
    for last in cuts:
        held = list(draw(st.dictionaries(name, label, max_size=3)).items())
        holds: list[Hold] = []
        for thing, attachment in held:
            by = draw(st.sampled_from([None, *holds]))
            holds.append(Hold(thing, attachment, by, draw(link) if by else None))
        phases.append(PhaseSpan(draw(label), first, last, tuple(holds)))
        first = last
    return Trajectory(names, times, rows, tuple(phases), robot)


def same(one: Trajectory, other: Trajectory) -> bool:
    return one.to_dict() == other.to_dict()


@pytest.fixture(scope="module")
def plan() -> Plan:
    return fake_plan()


def broken(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


# There and back


@FILES
@given(trajectory=trajectories())
def test_tables_are_exact(trajectory: Trajectory, tmp_path: Path) -> None:
    assert same(Trajectory.from_csv(trajectory.to_csv(tmp_path / "motion.csv")), trajectory)


@FILES
@given(trajectory=trajectories())
def test_json_is_exact(trajectory: Trajectory, tmp_path: Path) -> None:
    assert same(Trajectory.from_json(trajectory.to_json(tmp_path / "motion.json")), trajectory)


@FILES
@given(trajectory=trajectories(largest=1e6))
def test_ros_is_exact_to_a_nanosecond(trajectory: Trajectory) -> None:
    back = Trajectory.from_ros(json.loads(json.dumps(trajectory.to_ros(joints="all"))), like=trajectory)
    np.testing.assert_allclose(back.times, trajectory.times - trajectory.times[0], rtol=0.0, atol=1e-9)
    assert {**back.to_dict(), "times": 0} == {**trajectory.to_dict(), "times": 0}


@pytest.mark.parametrize("name", ["a\rb", "\n", "\r\n", 'a "quoted", name'])
def test_names_with_line_ends_come_back(name: str, tmp_path: Path) -> None:
    phase = PhaseSpan(name, 0, 1, (Hold(name, name), Hold("other", name, Hold(name, name), name)))
    trajectory = Trajectory(ROBOT[:3], np.arange(2.0), np.zeros((2, 3)), (phase,), 3)
    assert same(Trajectory.from_csv(trajectory.to_csv(tmp_path / "motion.csv")), trajectory)


def test_a_plan_comes_back(plan: Plan, tmp_path: Path) -> None:
    assert same(Trajectory.from_csv(plan.to_csv(tmp_path / "door.csv")), plan.trajectory)
    assert same(Trajectory.from_json(plan.to_json(tmp_path / "door.json")), plan.trajectory)
    path = broken(tmp_path / "ros.json", json.dumps(plan.to_ros(joints="all")))
    back = Trajectory.from_ros(path, like=plan.trajectory)
    assert (back.phases, back.positions.tolist()) == (plan.trajectory.phases, plan.trajectory.positions.tolist())


# Tables


def test_columns_have_names_and_units(plan: Plan, tmp_path: Path) -> None:
    with plan.to_csv(tmp_path / "door.csv").open(encoding="utf-8", newline="") as file:
        lines = list(csv.reader(file))
    assert lines[0][:4] == ["time [s]", "base_x [m]", "base_y [m]", "base_yaw [rad]"]
    assert lines[0][-6:] == ["door.hinge [rad]", "door.knob [rad]", "door.handle", "phase", "phase_name", "held"]
    assert len(lines) == 1 + len(plan.trajectory.times)
    assert lines[1][-3:] == ["1", "reach door.handle", "{}"]
    assert lines[8][-3:] == ["2", "move door.hinge", '{"door": "handle"}']
    assert [float(cell) for cell in lines[5][1:4]] == plan.trajectory.positions[4, :3].tolist()


def test_units_of_joints_that_slide_and_of_grasps() -> None:
    units = units_of(vkc.load_scene("drawer"))
    assert (units["drawer.slide"], units["base_x"], units["base_yaw"]) == ("m", "m", "rad")
    stick = units_of(vkc.load_scene("init_3"))
    assert {stick[name] for name in stick if name.endswith("_slide")} == {"m"}
    assert {stick[name] for name in stick if name.endswith("_turn")} == {"rad"}


def test_every_coordinate_of_a_plan_has_a_unit(door_plan: Plan) -> None:
    assert set(door_plan.trajectory.names) <= set(units_of(door_plan.scene))


@pytest.mark.parametrize(
    ("joints", "count"), [("robot", 9), ("base", 3), ("arm", 6), ("objects", 3), (["door.hinge", "base_x"], 2), ("all", 12)]
)
def test_some_of_the_joints(plan: Plan, tmp_path: Path, joints: Any, count: int) -> None:
    header = plan.to_csv(tmp_path / "some.csv", joints=joints).read_text(encoding="utf-8").splitlines()[0].split(",")
    assert len(header) == 1 + count + 3
    names = plan.to_ros(joints=joints)["joint_names"]
    assert [re.sub(r" \[.*", "", name) for name in header[1:-3]] == names
    assert all(len(point["positions"]) == count for point in plan.to_ros(joints=joints)["points"])


def test_names_that_there_are_not(plan: Plan, tmp_path: Path) -> None:
    with pytest.raises(vkc.UnknownNameError, match="did you mean 'robot'"):
        plan.to_ros(joints="robo")
    with pytest.raises(vkc.UnknownNameError, match=r"joints\[1\].*door.hinge"):
        plan.to_csv(tmp_path / "x.csv", joints=["base_x", "door.hinges"])
    with pytest.raises(vkc.InputError, match="twice"):
        plan.to_ros(joints=["base_x", "base_x"])
    assert list(tmp_path.iterdir()) == []


def test_a_table_from_elsewhere(tmp_path: Path) -> None:
    text = "\ufefftime,base_x,base_y,base_yaw,door.hinge\r\n0,0,0,0,0\r\n\r\n0.5,1,2,3,4\r\n"
    found = Trajectory.from_csv(broken(tmp_path / "own.csv", text))
    assert (found.names, found.robot_size) == (("base_x", "base_y", "base_yaw", "door.hinge"), 3)
    assert found.phases == (PhaseSpan("motion", 0, 1),)
    assert found.positions[1].tolist() == [1.0, 2.0, 3.0, 4.0]
    assert Trajectory.from_csv(tmp_path / "own.csv", robot_size=4).robot_size == 4


HEAD = "time [s],base_x [m],base_y [m],base_yaw [rad],phase,phase_name,held\n"
GOOD = "0.0,0,0,0,1,go,{}\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "bad.csv: an empty file"),
        ("x,y\n", "bad.csv:1: first column: not a table of waypoints .expected time, got 'x'"),
        (HEAD + "0.0,0,0\n", "bad.csv:2: wrong number of columns .expected 7, got 3"),
        (HEAD + GOOD + "1.0,0,zero,0,1,go,{}\n", "bad.csv:3: base_y: not a number .expected a finite number, got 'zero'"),
        (HEAD + GOOD + "1.0,nan,0,0,1,go,{}\n", "bad.csv:3: base_x: not a number"),
        (HEAD + GOOD + "1.0,0,0,0,3,go,{}\n", "bad.csv:3: phase: not the next phase .expected 1 or 2, got '3'"),
        (HEAD + "0.0,0,0,0,2,go,{}\n", "bad.csv:2: phase: not the next phase .expected 1, got '2'"),
        (HEAD + "0.0,0,0,0,1,go,door\n", "bad.csv:2: held: not what is held"),
        (HEAD + '0.0,0,0,0,1,go,"{""door"": 3}"\n', "bad.csv:2: held: not what is held"),
        (HEAD + '0.0,0,0,0,1,go,"[1]"\n', "bad.csv:2: held: not what is held"),
        (HEAD + GOOD, "bad.csv: Trajectory.times: times do not increase"),
        (HEAD + GOOD + GOOD, "bad.csv: Trajectory.times: times do not increase"),
        ("time,arm\n0,0\n1,1\n", "bad.csv: Trajectory.robot_size: out of range"),
        ("time\n0\n1\n", "bad.csv: Trajectory.robot_size: out of range"),
    ],
)
def test_bad_tables(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(vkc.InputError, match=message):
        Trajectory.from_csv(broken(tmp_path / "bad.csv", text))


def test_files_that_are_not_there_or_no_text(tmp_path: Path) -> None:
    for read in (Trajectory.from_csv, Trajectory.from_json, Trajectory.from_ros):
        with pytest.raises(vkc.InputError, match=r"none.csv: no such file"):
            read(tmp_path / "none.csv")
        (tmp_path / "picture").write_bytes(b"\xff\xfe\x00")
        with pytest.raises(vkc.InputError, match=r"picture: not text .expected UTF-8"):
            read(tmp_path / "picture")


# JSON


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{\n1", "bad.json:2: not JSON"),
        ("[]", "bad.json: not a trajectory .expected an object, got list"),
        ("{}", "bad.json: phases: this is missing"),
        ('{"trajectory": 3}', "bad.json: trajectory: not a trajectory"),
        ('{"trajectory": {"names": []}}', "bad.json: trajectory.phases: this is missing"),
        ('{"names": [], "phases": 3}', "bad.json: not a trajectory"),
        (
            '{"names": ["a"], "times": [0, 1], "positions": [[1], ["x"]], "robot_size": 3, "phases": []}',
            r"bad.json: Trajectory.positions: not numbers",
        ),
    ],
)
def test_bad_json(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(vkc.InputError, match=message):
        Trajectory.from_json(broken(tmp_path / "bad.json", text))


# ROS


def test_a_message_has_the_fields_of_a_joint_trajectory(plan: Plan) -> None:
    message = plan.to_ros(frame="map", stamp=1.5)
    assert json.loads(json.dumps(message)) == message, "plain data"
    assert set(message) == {"header", "joint_names", "points"}
    assert message["header"] == {"stamp": {"sec": 1, "nanosec": 500_000_000}, "frame_id": "map"}
    assert message["joint_names"] == list(plan.trajectory.names[:9]), "what has a motor"
    for point, moment in zip(message["points"], plan.trajectory.times, strict=True):
        assert set(point) == {"positions", "velocities", "accelerations", "effort", "time_from_start"}
        assert {len(point[key]) for key in ("positions", "velocities", "accelerations")} == {9}
        assert point["effort"] == []
        since = point["time_from_start"]
        assert type(since["sec"]) is type(since["nanosec"]) is int
        assert 0 <= since["nanosec"] < 1_000_000_000
        assert since["sec"] + 1e-9 * since["nanosec"] == pytest.approx(moment, abs=1e-9)
    for end in (message["points"][0], message["points"][-1]):
        assert set(end["velocities"]) == {0.0}


def test_fewer_derivatives(plan: Plan) -> None:
    for count in (0, 1, 2):
        point = plan.to_ros(derivatives=count)["points"][1]
        assert [len(point["velocities"]) > 0, len(point["accelerations"]) > 0] == [count > 0, count > 1]


@pytest.mark.parametrize("rate", [1.0, 7.0, 50])
def test_points_at_a_rate(plan: Plan, rate: float) -> None:
    message = plan.to_ros(rate=rate, joints="all")
    times = np.array([p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in message["points"]])
    assert len(times) == np.ceil(6.0 * rate) + 1
    np.testing.assert_allclose(times[:-1], np.arange(len(times) - 1) / rate, atol=1e-9)
    assert times[-1] == pytest.approx(6.0)
    assert message["points"][0]["positions"] == plan.trajectory.positions[0].tolist()
    assert message["points"][-1]["positions"] == plan.trajectory.positions[-1].tolist()
    assert np.ptp([point["positions"] for point in message["points"]], axis=0) == pytest.approx(
        np.ptp(plan.trajectory.positions, axis=0)
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rate": 0.0}, "rate: out of range"),
        ({"rate": "10"}, "rate: out of range"),
        ({"derivatives": 3}, "derivatives: out of range"),
        ({"stamp": -1.0}, "stamp: out of range"),
    ],
)
def test_bad_options(plan: Plan, options: dict[str, Any], message: str) -> None:
    with pytest.raises(vkc.InputError, match=message):
        plan.to_ros(**options)


def changed(message: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    """Return a copy with another value at a path such as "points/0/positions"; None removes it."""
    copy = json.loads(json.dumps(message))
    *way, last = [int(part) if part.isdigit() else part for part in path.split("/")]
    inner = copy
    for part in way:
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
        ("joint_names", "x", "joint_names: wrong kind of value .expected a list, got 'x'"),
        ("joint_names/1", "base_x", "Trajectory.names: a name occurs twice"),
        ("points", {}, "points: wrong kind of value"),
        ("points", [], "Trajectory.times: times do not increase"),
        ("points/2", 3, r"points\[2\].positions: this is missing"),
        ("points/2/positions", [1.0], r"points\[2\].positions: wrong number of values .expected 9, got 1"),
        ("points/2/positions/4", "far", r"points\[2\].positions\[4\]: not a number .expected a number, got 'far'"),
        ("points/2/positions/4", True, r"points\[2\].positions\[4\]: not a number"),
        ("points/2/positions/4", float("nan"), r"Trajectory.positions\[2, 4\]: not finite"),
        ("points/1/time_from_start/sec", 0.5, r"points\[1\].time_from_start.sec: wrong kind of value .expected a whole number"),
        ("points/1/time_from_start", None, r"points\[1\].time_from_start: this is missing"),
        ("points/1/time_from_start/nanosec", None, r"points\[1\].time_from_start.nanosec: this is missing"),
        ("points/1/time_from_start/sec", 5, "Trajectory.times: times do not increase"),
    ],
)
def test_bad_messages(plan: Plan, tmp_path: Path, path: str, value: Any, expected: str) -> None:
    message = changed(plan.to_ros(), path, value)
    with pytest.raises(vkc.InputError, match=f"^{expected}"):
        Trajectory.from_ros(message)
    with pytest.raises(vkc.InputError, match=f"bad.json: {expected}"):
        Trajectory.from_ros(broken(tmp_path / "bad.json", json.dumps(message)))


def test_the_arm_alone_is_no_trajectory(plan: Plan) -> None:
    few = plan.to_ros(joints=list(plan.trajectory.names[3:5]))
    with pytest.raises(vkc.InputError, match="robot_size: out of range"):
        Trajectory.from_ros(few)


@pytest.mark.parametrize("smooth", [True, False])
def test_what_is_sent_can_be_validated(door_plan: Plan, smooth: bool) -> None:
    """Between waypoints, on lines or cubics, the motion does what was asked for, and keeps its distances."""
    sent = Trajectory.from_ros(door_plan.to_ros(joints="all", rate=50, smooth=smooth), like=door_plan.trajectory)
    assert [phase.name for phase in sent.phases] == [phase.name for phase in door_plan.trajectory.phases]
    report = vkc.validate(door_plan.scene, door_plan.steps, sent, door_plan.options)
    wrong = {"acceleration", "closure"} if smooth else {"acceleration"}  # it jumps between linear pieces
    assert {violation.constraint for violation in report.violations} <= wrong, report.lines()
    assert report.closure_error < (2e-3 if smooth else 1e-3)
    assert np.abs(sent.positions - door_plan.trajectory.at(sent.times)).max() < (0.02 if smooth else 1e-9)


# The command line


def test_export_of_a_saved_plan(plan: Plan, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    saved, out = plan.save(tmp_path / "door.npz"), tmp_path / "new"
    files = [part for kind in ("csv", "json", "ros") for part in (f"--{kind}", str(out / kind))]
    assert cli.main(["export", str(saved), *files]) == 0
    assert capsys.readouterr().out.splitlines() == [f"wrote {out / kind}" for kind in ("csv", "json", "ros")]
    assert same(Trajectory.from_csv(out / "csv"), plan.trajectory)
    assert same(Trajectory.from_json(out / "json"), plan.trajectory)
    assert json.loads((out / "ros").read_text(encoding="utf-8")) == plan.to_ros()
    assert cli.main(["export", str(saved), "--ros", str(out / "arm"), "--joints", "arm", "--rate", "10"]) == 0
    assert json.loads((out / "arm").read_text(encoding="utf-8")) == plan.to_ros(joints="arm", rate=10)
    assert cli.main(["export", str(saved), "--csv", str(out / "two"), "--joints", "base_x,door.hinge"]) == 0
    assert (out / "two").read_text(encoding="utf-8").startswith("time [s],base_x [m],door.hinge [rad],phase")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "nothing to write"),
        (["--csv", "x.csv", "--rate", "10"], "--rate: only ROS"),
        (["--csv", "x.csv", "--joints", "arms"], "there is no coordinate 'arms'"),
        (["--ros", "x.json", "--rate", "0"], "rate: out of range"),
    ],
)
def test_misuse(
    plan: Plan,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    options: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["export", str(plan.save(tmp_path / "door.npz")), *options]) == 2
    assert message in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["door.npz"]
