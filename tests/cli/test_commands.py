from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import os
import platform
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.executions import plan_drawer

import vkc_pin as vkc
from vkc_pin import cli
from vkc_pin.benchmarks import door
from vkc_pin.cli import commands, main

TIMED_OUT = [
    "plan",
    "drawer",
    "--set",
    "drawer.slide=0.3",
    "--quiet",
    "--time-limit",
    "0.001",
    "--initialization",
    "stationary",
]


class Run:
    """Exit code, outputs and folder of a command."""

    def __init__(self, code: int, out: str, err: str, folder: Path) -> None:
        self.code, self.out, self.err, self.folder = code, out, err, folder


@pytest.fixture(scope="module")
def planned(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Plan the door with outputs in folders that do not exist yet."""
    folder = tmp_path_factory.mktemp("cli") / "new" / "out"
    files = [
        part
        for kind in ("html", "save", "json", "plots")
        for part in (f"--{kind}", str(folder / OUTPUT_NAMES[kind]))
    ]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = cli.main(["plan", "door", "--set", "door.hinge=1.2", *files])
    return Run(code, out.getvalue(), err.getvalue(), folder)


OUTPUT_NAMES = {"html": "door.html", "save": "door.npz", "json": "door.json", "plots": "plots"}


def run_misused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Run a misused command and return its error; it must print no output and no traceback."""
    try:
        code = cli.main(list(arguments))
    except SystemExit as stop:  # raised by argparse
        code = int(stop.code or 0)
    captured = capsys.readouterr()
    assert code == 2, captured
    assert captured.out == ""
    assert "Traceback" not in captured.err
    return captured.err


def test_plan_prints_a_report_and_writes_every_output(planned: Run) -> None:
    assert planned.code == 0, planned.err
    assert "door: success" in planned.out
    assert "every constraint holds" in planned.out
    for kind, name in OUTPUT_NAMES.items():
        assert f"wrote {planned.folder / name}" in planned.out, kind
    assert "round  1" in planned.err  # progress
    assert "Traceback" not in planned.err
    plan = vkc.Plan.load(planned.folder / "door.npz")
    assert plan.success
    data = json.loads((planned.folder / "door.json").read_text(encoding="utf-8"))
    assert data["success"]
    np.testing.assert_array_equal(data["trajectory"]["positions"], plan.trajectory.positions)
    page = (planned.folder / "door.html").read_text(encoding="utf-8")
    assert page.lstrip().lower().startswith("<!doctype html>")
    assert len(list((planned.folder / "plots").glob("*.png"))) >= 3


def test_check_reports_reached_and_blocked_attachments(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["check", "drawer", "--plot", str(tmp_path / "drawer.png")]) == 0
    out = capsys.readouterr().out
    assert "drawer.handle, approach (1.00, 0.00, 0.00): reached from (" in out
    assert f"wrote {tmp_path / 'drawer.png'}" in out
    assert (tmp_path / "drawer.png").stat().st_size > 10_000
    document = vkc.load_scene("drawer").document
    box = {"name": "box", "type": "box", "size": [0.2, 1.6, 1.2], "position": [1.66, 0.0, 0.6]}
    (tmp_path / "blocked.yaml").write_text(yaml.safe_dump({**document, "obstacles": [box]}))
    assert cli.main(["check", str(tmp_path / "blocked.yaml")]) == 1
    assert "not reached" in capsys.readouterr().out


def test_check_validates_a_saved_plan(
    planned: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = str(planned.folder / "door.npz")
    assert cli.main(["check", file]) == 0
    assert "every constraint holds" in capsys.readouterr().out
    plan = vkc.Plan.load(file)
    positions = plan.trajectory.positions.copy()
    positions[5, 2] += 1.5
    bent = dataclasses.replace(
        plan, trajectory=dataclasses.replace(plan.trajectory, positions=positions, curve=None)
    )
    assert cli.main(["check", str(bent.save(tmp_path / "bent.npz"))]) == 1
    out = capsys.readouterr().out
    assert "velocity base_yaw" in out
    assert f"(waypoint 5, {plan.trajectory.times[5]:.2f} s)" in out
    assert "the file says otherwise: every constraint holds" in out
    clearance = plan.report.clearance
    report = dataclasses.replace(plan.report, clearance=clearance + 0.1)
    better = dataclasses.replace(plan, report=report).save(tmp_path / "better.npz")
    assert cli.main(["check", str(better)]) == 1
    first, second = capsys.readouterr().out.splitlines()
    assert first.endswith("every constraint holds")
    assert second.endswith(f": clearance {clearance + 0.1:.6g} m instead of {clearance:.6g} m")


def test_view_writes_a_page(
    planned: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for source, name in ((str(planned.folder / "door.npz"), "plan.html"), ("drawer", "scene.html")):
        page = tmp_path / name
        assert cli.main(["view", source, "--html", str(page)]) == 0
        assert page.stat().st_size > 10_000
        assert str(page) in capsys.readouterr().out


def test_failed_plan_is_written_and_returns_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "late.json"
    assert cli.main([*TIMED_OUT, "--json", str(path)]) == 1
    captured = capsys.readouterr()
    assert captured.out.startswith("drawer: FAILED, time limit")
    assert captured.err == ""  # --quiet
    data = json.loads(path.read_text(encoding="utf-8"))
    assert (data["success"], data["status"]) == (False, "time limit")
    assert data["violations"]


@pytest.mark.parametrize(
    ("words", "texts"),
    [
        ("plan dor --set door.hinge=1", ["dor", "did you mean 'door'"]),
        ("plan nowhere/door.yaml --set door.hinge=1", ["nowhere/door.yaml"]),
        ("plan door --set dor.hinge=1", ["there is no object 'dor'", "did you mean 'door'"]),
        ("plan door --set door.hing=1", ["hing", "did you mean 'hinge'"]),
        ("plan door --set door.hinge", ["--set", "OBJECT.JOINT=VALUE", "'door.hinge'"]),
        ("plan door --set hinge=1", ["--set", "OBJECT.JOINT=VALUE"]),
        ("plan door --set door.hinge=wide", ["--set", "not a number", "'door.hinge=wide'"]),
        ("plan door --set door.hinge=nan", ["not finite"]),
        ("plan door", ["--set", "--reach", "--go-to"]),
        ("plan door --go-to 1 2", ["--go-to", "3"]),
        ("plan door --reach 1 0 0 0 up 0", ["--reach", "'up'"]),
        ("plan door --set door.hinge=1 --initialization stationry", ["did you mean 'stationary'"]),
        ("plan door --set door.hinge=1 --time-limit -1", ["time_limit", "more than 0"]),
        ("plan door --set door.hinge=1 --max-evaluations 0", ["max_evaluations", "at least 1"]),
        ("plan door --set door.hinge=1 --time-limit soon", ["--time-limit", "soon"]),
        ("plan door --set door.hinge=1 --seed -1", ["--seed", "at least 0"]),
        ("plan door --st x", ["usage: vkc-pin plan ", "--st x"]),
        ("check door.json", ["door.json", "a saved plan (.npz) or a scene (.yaml)"]),
        ("check none.npz", ["none.npz", "No such file"]),
        ("view none.npz", ["none.npz", "No such file"]),
        ("view drawr", ["did you mean 'drawer'"]),
        ("bench door --trials 0", ["--trials", "at least 1"]),
        ("bench initialization --out o --jobs -2", ["--jobs", "at least 1", "'-2'"]),
        ("bench initialization --out o --scenes init1", ["'init1'", "did you mean 'init_1'"]),
        ("bench initialization --out o --methods astra", ["'astra'", "did you mean 'astar'"]),
        ("srdf husky_ur5 --output x.srdf", ["husky_ur5e"]),
        ("srdf husky_ur5e", ["--output"]),
        ("", ["COMMAND"]),
    ],
)
def test_misuse_is_explained(
    words: str, texts: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    error = run_misused(capsys, *words.split())
    for text in texts:
        assert text in error


def test_invalid_files_are_named(
    planned: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "notes.npz").write_text("door")
    assert "not a saved plan" in run_misused(capsys, "check", str(tmp_path / "notes.npz"))
    scene = tmp_path / "hall.yaml"
    scene.write_text("robot: husky_ur5e\nstart: {base: [0, 0]}\n")
    error = run_misused(capsys, "plan", str(scene), "--set", "door.hinge=1")
    assert f"{scene}:2" in error
    assert "start.base" in error
    plan = str(planned.folder / "door.npz")
    assert "--plot" in run_misused(capsys, "check", plan, "--plot", "door.png")


@pytest.mark.parametrize(
    ("options", "texts"),
    [
        ("--save file/plan.npz", ["--save: cannot write this", "Not a directory"]),
        ("--save folder", ["--save: cannot write this", "got a folder"]),
        ("--json pipe", ["--json: cannot write this", "got a pipe"]),
        ("--plots picture.png", ["--plots: this is the name of a picture", "expected a folder"]),
        ("--save one --csv folder/../one", ["--csv: this file is named twice", "than --save"]),
        ("--ros one --html one/page.html", ["--html: a file cannot be a folder"]),
    ],
)
def test_unwritable_outputs_are_rejected_before_planning(
    options: str,
    texts: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    error = run_misused(capsys, *TIMED_OUT, *options.split())
    assert [text for text in texts if text not in error] == []
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "folder", "pipe"]


@pytest.mark.parametrize(
    "command",
    [
        ["export", "PLAN", "--json", "PLAN"],
        ["view", "PLAN", "--html", "PLAN"],
        ["srdf", "PLAN", "--output", "PLAN"],
    ],
)
def test_input_file_is_not_overwritten(
    command: list[str], planned: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    file = planned.folder / "door.npz"
    before = file.read_bytes()
    assert "this file is named twice" in run_misused(
        capsys, *[word.replace("PLAN", str(file)) for word in command]
    )
    assert file.read_bytes() == before


def test_version_lists_dependencies(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["--version"])
    assert stop.value.code == 0
    versions = dict(part.split() for part in " ".join(capsys.readouterr().out.split()).split(", "))
    assert list(versions) == ["vkc-pin", "pin", "coal", "casadi", "numpy", "Python"]
    assert versions["vkc-pin"] == vkc.__version__
    assert versions["Python"] == platform.python_version()
    assert "unknown" not in versions.values()


def test_exit_code_distinguishes_infeasible_from_failed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(tmp_path / "plan.npz")
    assert cli.main(["plan", "drawer", "--set", "drawer.slide=9", "--quiet", "--save", path]) == 3
    assert capsys.readouterr().out.startswith("drawer: FAILED, infeasible")
    assert cli.main(["check", path]) == 1
    capsys.readouterr()
    command = ["plan", "drawer", "--set", "drawer.slide=0.3", "--max-evaluations", "500", "--quiet"]
    assert cli.main(command) == 1
    assert capsys.readouterr().out.startswith("drawer: FAILED, evaluation limit")


def test_consecutive_settings_of_an_object_become_one_step() -> None:
    settings = ["door.knob=0.5", "door.hinge=1.2", "drawer.slide=0.3", "door.hinge=0"]
    assert commands.parse_settings([*settings, "door.hinge = 1"]) == [
        vkc.Actuate("door", {"knob": 0.5, "hinge": 1.2}),
        vkc.Actuate("drawer", {"slide": 0.3}),
        vkc.Actuate("door", {"hinge": 0.0}),
        vkc.Actuate("door", {"hinge": 1.0}),
    ]


def test_srdf_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "husky.srdf"
    command = ["srdf", "husky_ur5e", "--output", str(path), "--samples", "50", "--seed", "1"]
    assert cli.main(command) == 0
    assert str(path) in capsys.readouterr().out
    assert "<disable_collisions" in path.read_text(encoding="utf-8")


def test_bench_door_records_every_trial(tmp_path: Path) -> None:
    path = tmp_path / "door.json"
    assert (
        cli.main(["bench", "door", "--trials", "1", "--seed", "3", "--quiet", "--json", str(path)])
        == 0
    )
    result = json.loads(path.read_text(encoding="utf-8"))
    meta = result["meta"]
    assert (meta["benchmark"], meta["seed"], meta["trials"]) == ("door", 3, 1)
    assert {trial["task"] for trial in result["trials"]} == set(door.TASKS)
    for trial in result["trials"]:
        assert (trial["scene"], trial["seed"], trial["number"]) == ("door", 3, 0)
        assert (trial["failed_constraint"] is None) == trial["success"]
        assert bool(trial["violations"]) != trial["success"]
    start = vkc.load_scene("door").sample_start(np.random.default_rng(3)).start
    reach = next(trial for trial in result["trials"] if trial["task"] == "reach")
    np.testing.assert_allclose(reach["start"], start, atol=1e-8)


@pytest.fixture
def plan(tmp_path: Path) -> str:
    return str(plan_drawer().save(tmp_path / "plan.npz"))


def test_saved_plan_is_executed(
    plan: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page, data = tmp_path / "page.html", tmp_path / "data.json"
    command = ["simulate", plan, "--html", str(page), "--json", str(data), "--grasp", "friction"]
    assert main(command) == 0
    output = capsys.readouterr().out
    assert "drawer in physics: ok" in output
    assert "slips by" in output
    assert f"wrote {page}" in output
    assert "in physics" in page.read_text(encoding="utf-8")
    assert json.loads(data.read_text(encoding="utf-8"))["ok"] is True


def test_misuse_is_explained_and_writes_nothing(
    plan: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = Path(plan).read_bytes()
    for options, expected in (
        (["--actual", "door", "--json", str(tmp_path / "data.json")], "lacks the object 'drawer'"),
        (["--json", plan], "--json"),
        (["--grasp", "glue"], "expected weld, friction, got glue"),
    ):
        assert main(["simulate", plan, *options]) == 2
        assert expected in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["plan.npz"]
    assert Path(plan).read_bytes() == before
