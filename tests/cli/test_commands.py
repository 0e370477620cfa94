from __future__ import annotations

import dataclasses
import inspect
import json
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import vkc_pin as vkc
from vkc_pin import cli
from vkc_pin.benchmarks import door, initialization
from vkc_pin.benchmarks.harness import record, runner
from vkc_pin.cli import commands
from vkc_pin.planning import planner
from vkc_pin.planning.sequential import plan_simultaneously

ROOT = Path(__file__).resolve().parents[2]
UNFINISHED = [
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
    """What one command printed and returned."""

    def __init__(self, code: int, out: str, err: str, folder: Path) -> None:
        self.code, self.out, self.err, self.folder = code, out, err, folder


@pytest.fixture(scope="module")
def planned(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The demo's command, with every output there is; into folders that do not exist yet."""
    folder = tmp_path_factory.mktemp("cli") / "new" / "out"
    files = [
        part
        for kind in ("html", "save", "json", "plots")
        for part in (f"--{kind}", str(folder / NAMES[kind]))
    ]
    command = [
        sys.executable,
        "-m",
        "vkc_pin.cli",
        "plan",
        "door",
        "--set",
        "door.hinge=1.2",
        *files,
    ]
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        command,
        cwd=folder.parent.parent,
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, "PYTHONPATH": path},
    )
    return Run(done.returncode, done.stdout, done.stderr, folder)


NAMES = {"html": "door.html", "save": "door.npz", "json": "door.json", "plots": "plots"}


def failed(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Return what a misused command says; it says it in one line, without a traceback."""
    try:
        code = cli.main(list(arguments))
    except SystemExit as stop:  # argparse's own
        code = int(stop.code or 0)
    captured = capsys.readouterr()
    assert code == 2, captured
    assert captured.out == ""
    assert "Traceback" not in captured.err
    return captured.err


def test_planning_the_demo(planned: Run) -> None:
    assert planned.code == 0, planned.err
    assert "door: success" in planned.out
    assert "every constraint holds" in planned.out
    for kind, name in NAMES.items():
        assert f"wrote {planned.folder / name}" in planned.out, kind
    assert "round  1" in planned.err  # progress goes beside the result
    assert "Traceback" not in planned.err


def test_what_it_writes(planned: Run) -> None:
    plan = vkc.Plan.load(planned.folder / "door.npz")
    assert plan.success
    data = json.loads((planned.folder / "door.json").read_text(encoding="utf-8"))
    assert data["success"]
    np.testing.assert_array_equal(data["trajectory"]["positions"], plan.trajectory.positions)
    page = (planned.folder / "door.html").read_text(encoding="utf-8")
    assert page.lstrip().lower().startswith("<!doctype html>")
    assert len(list((planned.folder / "plots").glob("*.png"))) >= 3


def test_check(planned: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check", str(planned.folder / "door.npz")]) == 0
    assert "every constraint holds" in capsys.readouterr().out


def test_check_of_a_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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


def test_a_plan_has_no_picture_of_its_scene(
    planned: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["check", str(planned.folder / "door.npz"), "--plot", "door.png"]) == 2
    assert "--plot" in capsys.readouterr().err


def test_check_finds_what_is_wrong(
    planned: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = vkc.Plan.load(planned.folder / "door.npz")
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


def test_view_writes_a_page(
    planned: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for what, name in ((str(planned.folder / "door.npz"), "plan.html"), ("drawer", "scene.html")):
        page = tmp_path / name
        assert cli.main(["view", what, "--html", str(page)]) == 0
        assert page.stat().st_size > 10_000
        assert str(page) in capsys.readouterr().out


def test_a_plan_that_fails_returns_1_and_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "late.json"
    assert cli.main([*UNFINISHED, "--json", str(path)]) == 1
    captured = capsys.readouterr()
    assert captured.out.startswith("drawer: FAILED, time limit")
    assert captured.err == ""  # --quiet
    data = json.loads(path.read_text(encoding="utf-8"))
    assert (data["success"], data["status"]) == (False, "time limit")
    assert data["violations"]


def test_max_evaluations_ends_planning(capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        cli.main(
            ["plan", "drawer", "--set", "drawer.slide=0.3", "--max-evaluations", "500", "--quiet"]
        )
        == 1
    )
    assert capsys.readouterr().out.startswith("drawer: FAILED, evaluation limit")


@pytest.mark.parametrize(
    ("arguments", "texts"),
    [
        (["plan", "dor", "--set", "door.hinge=1"], ["dor", "did you mean 'door'"]),
        (["plan", "nowhere/door.yaml", "--set", "door.hinge=1"], ["nowhere/door.yaml"]),
        (
            ["plan", "door", "--set", "dor.hinge=1"],
            ["there is no object 'dor'", "did you mean 'door'"],
        ),
        (["plan", "door", "--set", "door.hing=1"], ["hing", "did you mean 'hinge'"]),
        (["plan", "door", "--set", "door.hinge"], ["--set", "OBJECT.JOINT=VALUE", "'door.hinge'"]),
        (["plan", "door", "--set", "hinge=1"], ["--set", "OBJECT.JOINT=VALUE"]),
        (
            ["plan", "door", "--set", "door.hinge=wide"],
            ["--set", "not a number", "'door.hinge=wide'"],
        ),
        (["plan", "door", "--set", "door.hinge=nan"], ["not finite"]),
        (["plan", "door", "--set", "=1"], ["--set"]),
        (["plan", "door"], ["--set"]),
        (
            ["plan", "door", "--set", "door.hinge=1", "--initialization", "stationry"],
            ["did you mean 'stationary'"],
        ),
        (
            ["plan", "door", "--set", "door.hinge=1", "--time-limit", "-1"],
            ["time_limit", "more than 0"],
        ),
        (
            ["plan", "door", "--set", "door.hinge=1", "--max-evaluations", "0"],
            ["max_evaluations", "at least 1"],
        ),
        (
            ["plan", "door", "--set", "door.hinge=1", "--time-limit", "soon"],
            ["--time-limit", "soon"],
        ),
        (["plan", "door", "--set", "door.hinge=1", "--seed", "-1"], ["--seed", "at least 0"]),
        (["check", "none.npz"], ["none.npz", "No such file"]),
        (["view", "none.npz"], ["none.npz", "No such file"]),
        (["view", "drawr"], ["did you mean 'drawer'"]),
        (["bench", "door", "--trials", "0"], ["--trials", "at least 1"]),
        (["bench", "dor"], ["dor"]),
        (["bench", "initialization"], ["--out"]),
        (["bench", "initialization", "--out", "o", "--starts", "0"], ["--starts", "at least 1"]),
        (
            ["bench", "initialization", "--out", "o", "--repeats", "none"],
            ["--repeats", "at least 1"],
        ),
        (
            ["bench", "initialization", "--out", "o", "--jobs", "-2"],
            ["--jobs", "at least 1", "'-2'"],
        ),
        (["bench", "initialization", "--out", "o", "--seed", "x"], ["--seed", "at least 0"]),
        (
            ["bench", "initialization", "--out", "o", "--scenes", "init1"],
            ["there is no scene 'init1'", "did you mean 'init_1'"],
        ),
        (
            ["bench", "initialization", "--out", "o", "--methods", "auto", "astra"],
            ["method 'astra'", "did you mean 'astar'"],
        ),
        (
            ["bench", "scale", "--out", "o", "--counts", "30", "0"],
            ["--counts", "at least 1", "'0'"],
        ),
        (["srdf", "husky_ur5", "--output", "x.srdf"], ["husky_ur5e"]),
        (["srdf", "husky_ur5e"], ["--output"]),
        ([], ["COMMAND"]),
        (["open"], ["open"]),
    ],
    ids=" ".join,
)
def test_misuse(arguments: list[str], texts: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    said = failed(capsys, *arguments)
    for text in texts:
        assert text in said


def test_a_file_that_is_no_plan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "notes.npz"
    path.write_text("door")
    assert "not a saved plan" in failed(capsys, "check", str(path))


def test_a_scene_with_a_mistake_in_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "hall.yaml"
    path.write_text("robot: husky_ur5e\nstart: {base: [0, 0]}\n")
    said = failed(capsys, "plan", str(path), "--set", "door.hinge=1")
    assert f"{path}:2" in said
    assert "start.base" in said


@pytest.mark.parametrize(
    ("options", "texts"),
    [
        (["--save", "file/plan.npz"], ["--save: cannot write this", "Not a directory"]),
        (["--save", "folder"], ["--save: cannot write this", "got a folder"]),
        (["--json", "pipe"], ["--json: cannot write this", "got a pipe"]),
        (["--html", ""], ["--html: cannot write this"]),
        (["--plots", "file"], ["--plots: cannot write this", "Not a directory"]),
        (
            ["--plots", "picture.png"],
            ["--plots: this is the name of a picture", "expected a folder"],
        ),
        (
            ["--save", "one", "--csv", "folder/../one"],
            ["--csv: this file is named twice", "another file than --save"],
        ),
        (["--ros", "one", "--html", "one/page.html"], ["--html: a file cannot be a folder"]),
        (["--save", "one", "--plots", "one"], ["--plots: a file cannot be a folder"]),
    ],
)
def test_places_that_cannot_be_written(
    options: list[str],
    texts: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """They are refused before there is anything to lose."""
    monkeypatch.setattr(planner, "plan_simultaneously", None)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    said = failed(capsys, *UNFINISHED, *options)
    assert [text for text in texts if text not in said] == []
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "folder", "pipe"]


@pytest.mark.parametrize(
    "command",
    [
        ["export", "PLAN", "--json", "PLAN"],
        ["view", "PLAN", "--html", "PLAN"],
        ["srdf", "PLAN", "--output", "PLAN"],
    ],
)
def test_what_is_read_is_not_written_over(
    command: list[str], planned: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    file = planned.folder / "door.npz"
    before = file.read_bytes()
    assert "this file is named twice" in failed(
        capsys, *[word.replace("PLAN", str(file)) for word in command]
    )
    assert file.read_bytes() == before


def test_one_file_that_fails_is_not_all(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder becomes a file while it plans."""

    def late(*arguments: Any) -> vkc.Plan:
        (tmp_path / "new").write_text("")
        return plan_simultaneously(*arguments)

    monkeypatch.setattr(planner, "plan_simultaneously", late)
    files = {
        "save": tmp_path / "plan.npz",
        "json": tmp_path / "new" / "plan.json",
        "csv": tmp_path / "plan.csv",
    }
    assert (
        cli.main(
            [
                *UNFINISHED,
                *(part for option, path in files.items() for part in (f"--{option}", str(path))),
            ]
        )
        == 2
    )
    captured = capsys.readouterr()
    assert captured.out.startswith("drawer: FAILED, time limit")
    assert captured.out.splitlines()[-2:] == [f"wrote {files['save']}", f"wrote {files['csv']}"]
    assert captured.err.startswith(f"vkc-pin: {files['json']}: cannot write this")
    assert vkc.Plan.load(files["save"]).status == "time limit"


def test_infeasible_is_3(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "plan.npz"
    assert (
        cli.main(["plan", "drawer", "--set", "drawer.slide=9", "--quiet", "--save", str(path)]) == 3
    )
    assert capsys.readouterr().out.startswith("drawer: FAILED, infeasible")
    assert cli.main(["check", str(path)]) == 1


def test_check_says_what_the_file_says_otherwise(
    planned: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = vkc.Plan.load(planned.folder / "door.npz")
    report = dataclasses.replace(plan.report, clearance=plan.report.clearance + 0.1)
    assert (
        cli.main(
            [
                "check",
                str(dataclasses.replace(plan, report=report).save(tmp_path / "better.npz")),
            ]
        )
        == 1
    )
    here = plan.report.clearance
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith("every constraint holds")
    assert (
        lines[1]
        == f"  the file says otherwise: clearance {here + 0.1:.6g} m instead of {here:.6g} m"
    )
    assert len(lines) == 2


def test_settings() -> None:
    steps = commands.parse_settings(
        ["door.knob=0.5", "door.hinge=1.2", "drawer.slide=0.3", "door.hinge=0", "door.hinge = 1"]
    )
    assert steps == [
        vkc.Actuate("door", {"knob": 0.5, "hinge": 1.2}),
        vkc.Actuate("drawer", {"slide": 0.3}),
        vkc.Actuate("door", {"hinge": 0.0}),
        vkc.Actuate("door", {"hinge": 1.0}),
    ]


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["--version"])
    assert stop.value.code == 0
    found = dict(part.split() for part in " ".join(capsys.readouterr().out.split()).split(", "))
    assert list(found) == ["vkc-pin", "pin", "coal", "casadi", "numpy", "Python"]
    assert found["vkc-pin"] == vkc.__version__
    assert found["Python"] == platform.python_version()
    assert "unknown" not in found.values()


def test_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    out = capsys.readouterr().out
    for command in ("plan", "check", "view", "bench", "srdf"):
        assert command in out


def test_srdf(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "husky.srdf"
    assert (
        cli.main(["srdf", "husky_ur5e", "--output", str(path), "--samples", "50", "--seed", "1"])
        == 0
    )
    assert str(path) in capsys.readouterr().out
    assert "<disable_collisions" in path.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> tuple[int, dict[str, Any]]:
    path = tmp_path_factory.mktemp("bench") / "door.json"
    code = cli.main(
        ["bench", "door", "--trials", "1", "--seed", "3", "--quiet", "--json", str(path)]
    )
    return code, json.loads(path.read_text(encoding="utf-8"), parse_constant=_no_json)


def _no_json(text: str) -> None:
    raise AssertionError(f"{text} is not JSON")


def test_bench(bench: tuple[int, dict[str, Any]]) -> None:
    code, result = bench
    assert code == 0
    assert set(result) == {"meta", "trials"}
    meta = result["meta"]
    assert (meta["benchmark"], meta["seed"], meta["trials"]) == ("door", 3, 1)
    assert {"vkc-pin", "pin", "coal", "casadi", "numpy"} <= set(meta["versions"])
    assert {"processor", "cores", "python", "system"} <= set(meta["machine"])
    assert 50.0 < meta["peak_memory_mb"] < 4000.0
    assert {t["task"] for t in result["trials"]} == set(door.TASKS)
    start = vkc.load_scene("door").sample_start(np.random.default_rng(3)).start
    for trial in result["trials"]:
        assert (trial["scene"], trial["seed"], trial["number"]) == ("door", 3, 0)
        for key, kind in {
            "method": str,
            "status": str,
            "success": bool,
            "planning_time": float,
            "base_path_length": float,
            "arm_path_length": float,
            "clearance": float,
            "closure_error": float,
            "iterations": int,
        }.items():
            assert isinstance(trial[key], kind), key
        assert (trial["failed_constraint"] is None) == trial["success"]
        assert bool(trial["violations"]) != trial["success"]
    reach = next(t for t in result["trials"] if t["task"] == "reach")
    np.testing.assert_allclose(reach["start"], start, atol=1e-8)


def test_the_bench_table(bench: tuple[int, dict[str, Any]]) -> None:
    _, result = bench
    text = door.table(result)
    for task in {t["task"] for t in result["trials"]}:
        assert any(line.startswith(task) for line in text.splitlines())
    assert "peak memory" in text
    sad = {
        **result["trials"][0],
        "success": False,
        "status": "rejected",
        "violations": ["goal base: elsewhere"],
    }
    assert "start 0, reach: rejected; goal base: elsewhere" in door.table(
        {**result, "trials": [sad]}
    )


@pytest.fixture
def experiment(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What `bench initialization` asks for; the experiment itself is at the door, and plans nothing."""
    asked: dict[str, Any] = {}
    real = initialization.run
    defaults = {name: one.default for name, one in inspect.signature(real).parameters.items()}

    def run(**given: Any) -> dict[str, Any]:
        asked.update(defaults | given)
        if "plan" not in asked:
            raise KeyboardInterrupt("2 of 6 trials are done and kept in out")
        return real(**{**given, "scenes": ["door"], "solve": lambda scene, spec: asked["plan"]})

    monkeypatch.setattr(initialization, "run", run)
    monkeypatch.setattr(runner, "_sources", lambda: "abc")
    return asked


def test_bench_initialization(
    experiment: dict[str, Any],
    door_plan: vkc.Plan,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    experiment["plan"] = door_plan
    out = str(tmp_path / "out")
    command = [
        "bench",
        "initialization",
        "--starts",
        "2",
        "--repeats",
        "3",
        "--seed",
        "4",
        "--jobs",
        "1",
        "--out",
        out,
    ]
    assert cli.main([*command, "--methods", "astar", "auto", "--quiet"]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    assert captured.out.startswith((tmp_path / "out" / "table.md").read_text(encoding="utf-8"))
    assert "| door | astar | 6 of 6 |" in captured.out
    assert out in captured.out.splitlines()[-1]
    names = {"results.csv", "results.json", "success.png", "table.md", "trials.jsonl"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == names
    given = {
        key: experiment[key]
        for key in ("starts", "repeats", "seed", "jobs", "out", "scenes", "methods", "progress")
    }
    assert given == {
        "starts": 2,
        "repeats": 3,
        "seed": 4,
        "jobs": 1,
        "out": out,
        "scenes": initialization.SCENES,
        "methods": ["astar", "auto"],
        "progress": False,
    }
    said = failed(capsys, *command, "--methods", "auto", "--quiet")
    assert "use another folder" in said
    assert "methods ['astar', 'auto'], got" in said


def test_ctrl_c_says_how_to_go_on(
    experiment: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["bench", "initialization", "--out", "my results"]) == 130
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "2 of 6 trials are done and kept in out" in captured.err
    assert captured.err.splitlines()[-1] == "vkc-pin bench initialization --out 'my results'"
    assert (
        experiment["starts"],
        experiment["repeats"],
        experiment["seed"],
        experiment["progress"],
    ) == (50, 1, 0, True)
    assert (experiment["scenes"], experiment["methods"]) == (
        initialization.SCENES,
        initialization.COMPARED_INITIALIZATIONS,
    )


def test_records_of_failures(door_plan: vkc.Plan) -> None:
    blame = vkc.Violation(
        "penetration",
        "forearm_link – sofa",
        waypoint=9,
        time=4.0,
        amount=0.03,
        unit="m",
        detail="overlap by 30 mm",
    )
    worse = dataclasses.replace(
        door_plan,
        report=vkc.Report((blame,)),
        status="rejected",
    )
    trial = record.trial(worse, method="VKC", seed=0, task="whole")
    assert (trial["success"], trial["failed_constraint"]) == (
        False,
        "penetration forearm_link – sofa",
    )
    assert trial["violations"] == [str(blame)]
    assert trial["task"] == "whole"
    json.dumps(trial, allow_nan=False)
    late = dataclasses.replace(door_plan, status="time limit")
    assert record.trial(late, method="VKC", seed=0)["failed_constraint"] == "time limit"


def test_distributions() -> None:
    rows = [{"x": value} for value in range(101)]
    assert record.distribution(rows, "x") == (50.0, 95.0)
    assert np.isnan(record.distribution([], "x")).all()
