"""Tests trajectories as CSV and JSON, their errors, and `vkc-pin export`."""

from __future__ import annotations

import csv
import json
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.expected_errors import expect_error
from helpers.trajectory_files import FILES, ROBOT, are_equal, trajectories, write_text_file
from hypothesis import given

import vkc_pin as vkc
from vkc_pin import cli
from vkc_pin.world.trajectory.curve import Curve


@pytest.mark.parametrize("kind", ["csv", "json"])
@FILES
@given(trajectory=trajectories())
def test_round_trips_are_exact(trajectory: vkc.Trajectory, kind: str, tmp_path: Path) -> None:
    file = getattr(trajectory, f"to_{kind}")(tmp_path / "motion")
    assert are_equal(getattr(vkc.Trajectory, f"from_{kind}")(file), trajectory)


def test_curves_and_openings_survive_files(tmp_path: Path) -> None:
    times, rows = np.array([0.0, 0.5, 1.0]), np.arange(9.0).reshape(3, 3)
    curve = Curve(times, rows, 0.1 * rows)
    phases = (vkc.PhaseSpan("go", 0, 1, opening=0.04),)
    trajectory = vkc.Trajectory(ROBOT[:3], times[[0, 2]], rows[[0, 2]], phases, 3, curve)
    table = trajectory.to_csv(tmp_path / "motion.csv")
    assert are_equal(vkc.Trajectory.from_csv(table), trajectory)
    assert are_equal(
        vkc.Trajectory.from_json(trajectory.to_json(tmp_path / "motion.json")), trajectory
    )
    table.write_text(table.read_text().replace("base_y velocity", "base_z velocity"))
    with expect_error("not the velocities of its coordinates"):
        vkc.Trajectory.from_csv(table)


def test_columns_have_names_and_units(plan: vkc.Plan, tmp_path: Path) -> None:
    with plan.to_csv(tmp_path / "door.csv").open(encoding="utf-8", newline="") as file:
        header, *lines = csv.reader(file)
    assert header[:4] == ["time [s]", "base_x [m]", "base_y [m]", "base_yaw [rad]"]
    assert header[-6:-3] == ["door.hinge [rad]", "door.knob [rad]", "door.handle_free [rad]"]
    assert header[-3:] == ["phase", "phase_name", "held"]
    assert len(lines) == len(plan.trajectory.times)
    assert lines[0][-3:] == ["1", "reach door.handle", "{}"]
    assert lines[7][-3:] == ["2", "move door.hinge", '{"door": "handle"}']
    assert [float(cell) for cell in lines[4][1:4]] == plan.trajectory.positions[4, :3].tolist()


@pytest.mark.parametrize(
    ("joints", "count"),
    [
        ("robot", 9),
        ("base", 3),
        ("arm", 6),
        ("objects", 3),
        (["door.hinge", "base_x"], 2),
        ("all", 12),
    ],
)
def test_joints_are_selected_by_group_or_name(
    plan: vkc.Plan, tmp_path: Path, joints: Any, count: int
) -> None:
    table, message = plan.to_csv(tmp_path / "some", joints=joints), plan.to_ros(joints=joints)
    columns = table.read_text().splitlines()[0].split(",")[1:-3]
    assert len(columns) == count
    assert [re.sub(r" \[.*", "", name) for name in columns] == message["joint_names"]
    assert {len(point["positions"]) for point in message["points"]} == {count}


def test_unknown_joints_are_rejected(plan: vkc.Plan, tmp_path: Path) -> None:
    with pytest.raises(vkc.UnknownNameError, match="did you mean 'robot'"):
        plan.to_ros(joints="robo")
    with pytest.raises(vkc.UnknownNameError, match=r"joints\[1\].*door.hinge"):
        plan.to_csv(tmp_path / "x.csv", joints=["base_x", "door.hinges"])
    with expect_error("twice"):
        plan.to_ros(joints=["base_x", "base_x"])
    assert list(tmp_path.iterdir()) == []


def test_plain_tables_are_read(tmp_path: Path) -> None:
    text = "\ufefftime,base_x,base_y,base_yaw,door.hinge\r\n0,0,0,0,0\r\n\r\n0.5,1,2,3,4\r\n"
    found = vkc.Trajectory.from_csv(write_text_file(tmp_path / "own.csv", text))
    assert (found.names, found.robot_size) == (("base_x", "base_y", "base_yaw", "door.hinge"), 3)
    assert found.phases == (vkc.PhaseSpan("motion", 0, 1),)
    assert found.positions[1].tolist() == [1.0, 2.0, 3.0, 4.0]
    assert vkc.Trajectory.from_csv(tmp_path / "own.csv", robot_size=4).robot_size == 4


def remove_columns(table: str, *removed: str) -> str:
    """Return a table without the columns whose names end so."""
    rows = list(csv.reader(table.splitlines()))
    kept = [k for k, name in enumerate(rows[0]) if not name.endswith(removed)]
    return "".join(",".join(row[k] for k in kept) + "\n" for row in rows)


@pytest.mark.parametrize("joints", ["robot", ["base_x", "base_y", "base_yaw"], "all"])
def test_velocities_need_no_marks_of_waypoints(
    door_plan: vkc.Plan, tmp_path: Path, joints: Any
) -> None:
    """They are no coordinates of their own; every line is a waypoint then."""
    text = door_plan.to_csv(tmp_path / "all.csv", joints=joints).read_text()
    bare = remove_columns(text, "waypoint", "phase", "phase_name", "held")
    size = len(door_plan.to_ros(joints=joints)["joint_names"])
    found = vkc.Trajectory.from_csv(write_text_file(tmp_path / "bare.csv", bare))
    motion = door_plan.trajectory
    assert found.names == motion.names[:size]
    np.testing.assert_array_equal(found.times, motion.curve.times)
    at = np.linspace(0.0, motion.times[-1], 300)
    np.testing.assert_allclose(found.at(at), motion.at(at)[:, :size], atol=1e-12)
    half = write_text_file(tmp_path / "half.csv", remove_columns(text, "base_y velocity [m/s]"))
    with expect_error("half.csv:1: not the velocities of its coordinates"):
        vkc.Trajectory.from_csv(half)


def test_columns_may_have_names_of_others(tmp_path: Path) -> None:
    names = ("base_x", "base_y", "base_yaw", "lift", "phase", "waypoint")
    rows = np.arange(12.0).reshape(2, 6)
    phases = (vkc.PhaseSpan("go", 0, 1),)
    motion = vkc.Trajectory(names, np.array([0.0, 1.0]), rows, phases, 6)
    assert are_equal(vkc.Trajectory.from_csv(motion.to_csv(tmp_path / "odd.csv")), motion)


HELD = '"{""door"": ""handle""}"'


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (f"2.0,0,0,0,1,go,{HELD}", "bad.csv:4: phase: phase 1 is another .*or the number 2"),
        ("2.0,0,0,0,1,turn,{}", "bad.csv:4: phase: phase 1 is another .*'go'.*'turn'"),
    ],
)
def test_changed_lines_inside_a_phase_are_rejected(
    tmp_path: Path, changed: str, message: str
) -> None:
    """Grasps that are edited in some lines of a phase would else have no effect."""
    rows = [ROW, "1.0,0,0,0,1,go,{ }\n", changed + "\n", "3.0,0,0,0,1,go,{}\n"]
    with expect_error(message):
        vkc.Trajectory.from_csv(write_text_file(tmp_path / "bad.csv", HEADER + "".join(rows)))
    rows[2:] = [f"2.0,0,0,0,2,go,{HELD}\n", f"3.0,0,0,0,2,go,{HELD}\n"]
    file = write_text_file(tmp_path / "good.csv", HEADER + "".join(rows))
    found = vkc.Trajectory.from_csv(file)
    assert [(phase.first, phase.last) for phase in found.phases] == [(0, 1), (1, 3)]


def test_changed_knots_inside_a_phase_are_rejected(door_plan: vkc.Plan, tmp_path: Path) -> None:
    """Lines that are no waypoints count as well."""
    table = door_plan.to_csv(tmp_path / "door.csv").read_text().splitlines(keepends=True)
    line = next(k for k, row in enumerate(table) if ",0,1,reach door.handle" in row)
    table[line] = table[line].replace("{}", HELD)
    with expect_error(rf"bad.csv:{line + 1}: phase: phase 1 is another"):
        vkc.Trajectory.from_csv(write_text_file(tmp_path / "bad.csv", "".join(table)))


HEADER = "time [s],base_x [m],base_y [m],base_yaw [rad],phase,phase_name,held\n"
ROW = "0.0,0,0,0,1,go,{}\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "bad.csv: an empty file"),
        ("x,y\n", "bad.csv:1: first column: not a table of waypoints .expected time, got 'x'"),
        (HEADER + "0.0,0,0\n", "bad.csv:2: wrong number of columns .expected 7, got 3"),
        (
            HEADER + ROW + "1.0,0,zero,0,1,go,{}\n",
            "bad.csv:3: base_y: not a number .expected a finite number, got 'zero'",
        ),
        (
            HEADER + ROW + "1.0,0,0,0,3,go,{}\n",
            "bad.csv:3: phase: not the next phase .expected 1 or 2, got '3'",
        ),
        (HEADER + "0.0,0,0,0,1,go,door\n", "bad.csv:2: held: not the held objects"),
        (HEADER + '0.0,0,0,0,1,go,"[1]"\n', "bad.csv:2: held: not the held objects"),
        (HEADER + ROW, "bad.csv: Trajectory.times: times do not increase"),
        ("time,arm\n0,0\n1,1\n", "bad.csv:1: no base coordinates"),
        ("time,a,b,c,d\n0,0,0,0,0\n1,1,1,1,1\n", "bad.csv:1: no base coordinates"),
    ],
)
def test_invalid_tables_are_rejected(tmp_path: Path, text: str, message: str) -> None:
    with expect_error(message):
        vkc.Trajectory.from_csv(write_text_file(tmp_path / "bad.csv", text))


@pytest.mark.parametrize("kind", ["csv", "json", "ros"])
def test_unreadable_files_are_rejected(tmp_path: Path, kind: str) -> None:
    read = getattr(vkc.Trajectory, f"from_{kind}")
    with expect_error(r"none: cannot read the (CSV|JSON) .*No such file"):
        read(tmp_path / "none")
    (tmp_path / "picture").write_bytes(b"\xff\xfe\x00")
    with expect_error(r"picture: cannot read the (CSV|JSON) .*no text: byte 0"):
        read(tmp_path / "picture")


@pytest.mark.parametrize(
    ("kind", "text", "message"),
    [
        ("csv", "time," + ",".join(map(str, range(1_000_000))), ":1: too many columns"),
        ("csv", "time,x,y,yaw\n" + "0,0,0,0\n" * 300_000, "too many lines"),
        ("csv", "time," + "x" * 200_000, ":1: not a table .got field larger"),
        ("csv", HEADER + "0,0,0,0,1,a," + "[" * 100_000, ":2: held: not the held objects"),
        ("json", "[" * 1_000_000, "too many lists|not JSON"),
        (
            "ros",
            '{"joint_names": ["x"], "points": [' + "[]," * 400_000 + "[]]}",
            "too many lists and objects",
        ),
        ("json", " " * 20_000_001, "the JSON is too large"),
    ],
    ids=lambda value: value if isinstance(value, str) and len(value) < 60 else "",
)
def test_large_and_deep_files_are_rejected_quickly(
    kind: str, text: str, message: str, tmp_path: Path
) -> None:
    began = time.process_time()
    with pytest.raises(vkc.InputError, match=message) as caught:
        getattr(vkc.Trajectory, f"from_{kind}")(write_text_file(tmp_path / "bad", text))
    assert len(str(caught.value)) < 5000
    assert time.process_time() - began < 10.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{\n1", "bad.json:2: not JSON"),
        ("[]", "bad.json: not a trajectory .expected an object, got list"),
        ("{}", "bad.json: names: missing"),
        ('{"trajectory": 3}', "bad.json: trajectory: not a trajectory"),
        (
            '{"names": [], "times": [], "positions": [], "robot_size": 3, "phases": 3}',
            "bad.json: phases: wrong value .expected a list, got 3",
        ),
        (
            '{"names": ["a"], "times": [0, 1], "positions": [[1], ["x"]],'
            ' "robot_size": 3, "phases": []}',
            r"bad.json: Trajectory.positions: not numbers",
        ),
    ],
)
def test_invalid_json_is_rejected(tmp_path: Path, text: str, message: str) -> None:
    with expect_error(message):
        vkc.Trajectory.from_json(write_text_file(tmp_path / "bad.json", text))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t["phases"][1].update(openning=1), r"phases\[1\].openning: .*'opening'"),
        (lambda t: t["phases"][0].pop("held"), r"trajectory.phases\[0\].held: missing"),
        (lambda t: t["curve"].update(rate=[]), "trajectory.curve.rate: .*'rate'.*'rates'"),
        (lambda t: t["curve"].pop("times"), "trajectory.curve.times: missing"),
        (lambda t: t.update(robotsize=9), "trajectory.robotsize: .*did you mean 'robot_size'"),
        (lambda t: t.update(curves=t.pop("curve")), "trajectory.curves: .*'curves'.*'curve'"),
    ],
)
def test_misspelt_fields_of_edited_plans_are_rejected(
    door_plan: vkc.Plan, tmp_path: Path, change: Callable[[Any], Any], message: str
) -> None:
    """They would have no effect, and lines would replace a curve."""
    data = json.loads(door_plan.to_json(tmp_path / "door.json").read_text())
    change(data["trajectory"])
    with expect_error(f"bad.json: .*{message}"):
        vkc.Trajectory.from_json(write_text_file(tmp_path / "bad.json", json.dumps(data)))


def test_export_of_a_saved_plan(
    plan: vkc.Plan, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    saved, out = str(plan.save(tmp_path / "door.npz")), tmp_path / "new"
    files = [part for kind in ("csv", "json", "ros") for part in (f"--{kind}", str(out / kind))]
    assert cli.main(["export", saved, *files]) == 0
    assert capsys.readouterr().out == "".join(f"wrote {file}\n" for file in files[1::2])
    assert are_equal(vkc.Trajectory.from_csv(out / "csv"), plan.trajectory)
    assert are_equal(vkc.Trajectory.from_json(out / "json"), plan.trajectory)
    assert json.loads((out / "ros").read_text()) == plan.to_ros()
    few = ["--joints", "base_x,door.hinge"]
    files = ["--ros", str(out / "ros"), "--csv", str(out / "csv")]
    assert cli.main(["export", saved, *files, *few, "--rate", "10"]) == 0
    message = plan.to_ros(joints=["base_x", "door.hinge"], rate=10)
    assert json.loads((out / "ros").read_text()) == message
    header = "time [s],base_x [m],door.hinge [rad],phase"
    assert (out / "csv").read_text().startswith(header)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "nothing to write"),
        (["--csv", "x.csv", "--rate", "10"], "--rate: only ROS"),
        (["--csv", "x.csv", "--joints", "arms"], "there is no coordinate 'arms'"),
        (["--ros", "x.json", "--rate", "0"], "rate: out of range"),
    ],
)
def test_invalid_export_options_are_rejected(
    plan: vkc.Plan,
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
