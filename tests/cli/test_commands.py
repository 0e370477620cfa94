from __future__ import annotations

import dataclasses
import json
import os
import platform
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.commands import RunCommand
from helpers.executions import plan_drawer

import vkc_pin as vkc
from vkc_pin.experiments import door
from vkc_pin.world.files.resources import find_resource_folder

TIMED_OUT = (
    "plan drawer --set drawer.slide=0.3 --quiet --time-limit 0.001 --initialization stationary"
)


def run_misused(run: RunCommand, command: str) -> str:
    """Run a misused command, which must print no output, and return its error."""
    result = run(command)
    assert (result.code, result.out) == (2, ""), result
    return result.err


def test_plan_prints_a_report_and_writes_every_output(run: RunCommand) -> None:
    outputs = {kind: f"new/out/drawer.{kind}" for kind in ("html", "json", "plots")}
    outputs["save"] = "new/out/drawer.npz"
    files = " ".join(f"--{kind} {name}" for kind, name in outputs.items())
    result = run(f"plan drawer --set drawer.slide=0.3 {files}")
    assert result.code == 0, result.err
    assert "drawer: success" in result.out
    assert "every constraint holds" in result.out
    for name in outputs.values():
        assert f"wrote {name}" in result.out
    assert "round  1" in result.err  # progress
    plan = vkc.Plan.load(outputs["save"])
    assert plan.success
    data = json.loads(Path(outputs["json"]).read_text(encoding="utf-8"))
    assert data["success"]
    np.testing.assert_array_equal(data["trajectory"]["positions"], plan.trajectory.positions)
    page = Path(outputs["html"]).read_text(encoding="utf-8")
    assert page.lstrip().lower().startswith("<!doctype html>")
    assert len(list(Path(outputs["plots"]).glob("*.png"))) >= 3


@pytest.mark.long
def test_check_reports_reached_and_blocked_attachments(run: RunCommand) -> None:
    result = run("check drawer --plot drawer.png")
    assert result.code == 0
    assert "drawer.handle, approach (1.00, 0.00, 0.00): reached from (" in result.out
    assert "wrote drawer.png" in result.out
    assert Path("drawer.png").stat().st_size > 10_000
    document = vkc.load_scene("drawer").document
    box = {"name": "box", "type": "box", "size": [0.2, 1.6, 1.2], "position": [1.66, 0.0, 0.6]}
    Path("blocked.yaml").write_text(yaml.safe_dump({**document, "obstacles": [box]}))
    result = run("check blocked.yaml")
    assert result.code == 1
    assert "not reached" in result.out


def test_check_validates_a_saved_plan(run: RunCommand, door_plan: vkc.Plan) -> None:
    plan = vkc.Plan.load(door_plan.save("door.npz"))
    result = run("check door.npz")
    assert result.code == 0
    assert "every constraint holds" in result.out
    positions = plan.trajectory.positions.copy()
    positions[5, 2] += 1.5
    bent = dataclasses.replace(plan.trajectory, positions=positions, curve=None)
    dataclasses.replace(plan, trajectory=bent).save("bent.npz")
    result = run("check bent.npz")
    assert result.code == 1
    assert "velocity base_yaw" in result.out
    assert f"(waypoint 5, {plan.trajectory.times[5]:.2f} s)" in result.out
    assert "the file says otherwise: every constraint holds" in result.out
    clearance = plan.report.clearance
    report = dataclasses.replace(plan.report, clearance=clearance + 0.1)
    dataclasses.replace(plan, report=report).save("better.npz")
    result = run("check better.npz")
    assert result.code == 1
    first, second = result.out.splitlines()
    assert first.endswith("every constraint holds")
    assert second.endswith(f": clearance {clearance + 0.1:.6g} m instead of {clearance:.6g} m")


def test_view_writes_a_page(run: RunCommand) -> None:
    plan_drawer().save("plan.npz")
    for source in ("plan.npz", "drawer"):
        result = run(f"view {source} --html page.html")
        assert result.code == 0
        assert "page.html" in result.out
        assert Path("page.html").stat().st_size > 10_000
        Path("page.html").unlink()


def test_failed_plan_is_written_and_returns_1(run: RunCommand) -> None:
    result = run(f"{TIMED_OUT} --json late.json")
    assert (result.code, result.err) == (1, "")  # --quiet
    assert result.out.startswith("drawer: FAILED, time limit")
    data = json.loads(Path("late.json").read_text(encoding="utf-8"))
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
        ("plan door --set door.hinge=wide", ["--set", "not a number", "'door.hinge=wide'"]),
        ("plan door --set door.hinge=nan", ["not finite"]),
        ("plan door", ["--set", "--reach", "--go-to"]),
        ("plan door --reach 1 0 0 0 up 0", ["--reach", "'up'"]),
        ("plan door --then", ["nothing to plan", "--set", "--place"]),
        ("plan door --grasp cup.", ["--grasp", "OBJECT.ATTACHMENT", "'cup.'"]),
        ("plan door --grasp dor", ["there is no object 'dor'", "did you mean 'door'"]),
        ("plan door --place door 1 2", ["--place", "OBJECT X Y Z", "2 numbers after 'door'"]),
        ("plan door --place door 1 2 high", ["--place", "not a number", "'high'"]),
        ("plan door --touch tool 1 2 high", ["--touch", "FRAME X Y Z", "'high'"]),
        ("plan door --release door", ["the hand is empty"]),
        ("plan door --set door.hinge=1 --initialization stationry", ["did you mean 'stationary'"]),
        ("plan door --set door.hinge=1 --time-limit -1", ["time_limit", "more than 0"]),
        ("plan door --st x", ["usage: vkc-pin plan ", "--st x"]),
        ("check door.json", ["door.json", "a saved plan (.npz) or a scene (.yaml)"]),
        ("check none.npz", ["none.npz", "No such file"]),
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
def test_misuse_is_explained(words: str, texts: list[str], run: RunCommand) -> None:
    error = run_misused(run, words)
    for text in texts:
        assert text in error


def test_invalid_files_are_named(run: RunCommand) -> None:
    Path("notes.npz").write_text("door")
    assert "not a saved plan" in run_misused(run, "check notes.npz")
    Path("hall.yaml").write_text("robot: husky_ur5e\nstart: {base: [0, 0]}\n")
    error = run_misused(run, "plan hall.yaml --set door.hinge=1")
    assert "hall.yaml:2" in error
    assert "start.base" in error


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
    options: str, texts: list[str], tmp_path: Path, run: RunCommand
) -> None:
    Path("file").write_text("")
    Path("folder").mkdir()
    os.mkfifo("pipe")
    error = run_misused(run, f"{TIMED_OUT} {options}")
    assert [text for text in texts if text not in error] == []
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "folder", "pipe"]


@pytest.mark.parametrize(
    ("command", "text"),
    [
        ("export plan.npz --json plan.npz", "this file is named twice"),
        ("view plan.npz --html plan.npz", "this file is named twice"),
        ("srdf plan.npz --output plan.npz", "this file is named twice"),
        ("simulate plan.npz --json plan.npz", "--json"),
        ("simulate plan.npz --actual a.yaml --json a.yaml", "another file than --actual"),
        ("simulate plan.npz --actual door --json data.json", "lacks the object 'drawer'"),
        ("simulate plan.npz --grasp glue", "expected weld, friction, got glue"),
        ("check plan.npz --plot door.png", "--plot"),
    ],
)
def test_misuse_with_a_saved_plan_changes_no_file(
    command: str, text: str, tmp_path: Path, run: RunCommand
) -> None:
    before = plan_drawer().save("plan.npz").read_bytes()
    assert text in run_misused(run, command)
    assert [file.name for file in tmp_path.iterdir()] == ["plan.npz"]
    assert Path("plan.npz").read_bytes() == before


def test_other_robot_of_the_actual_scene_is_named(run: RunCommand) -> None:
    plan_drawer().save("plan.npz")
    scene = find_resource_folder("scenes") / "drawer.yaml"
    Path("other.yaml").write_text(scene.read_text().replace("husky_ur5e", "panda"))
    error = run_misused(run, "simulate plan.npz --actual other.yaml")
    assert "`actual` has another robot (expected husky_ur5e, got panda)" in error


def test_page_does_not_replace_the_description_in_a_folder(run: RunCommand) -> None:
    Path("hall").mkdir()
    Path("hall/scene.yaml").write_text("[1]")
    assert "named twice" in run_misused(run, "view hall --html hall/scene.yaml")
    assert "hall/scene.yaml:1: wrong value" in run_misused(run, "view hall/scene.yaml")


def test_version_lists_dependencies(run: RunCommand) -> None:
    result = run("--version")
    assert result.code == 0
    versions = dict(part.split() for part in " ".join(result.out.split()).split(", "))
    assert list(versions) == ["vkc-pin", "pin", "coal", "casadi", "numpy", "Python"]
    assert versions["vkc-pin"] == vkc.__version__
    assert versions["Python"] == platform.python_version()
    assert "unknown" not in versions.values()


def test_exit_code_distinguishes_infeasible_from_failed(run: RunCommand) -> None:
    result = run("plan drawer --set drawer.slide=9 --quiet --save plan.npz")
    assert result.code == 3
    assert result.out.startswith("drawer: FAILED, infeasible")
    assert run("check plan.npz").code == 1
    result = run("plan drawer --set drawer.slide=0.3 --max-evaluations 500 --quiet")
    assert result.code == 1
    assert result.out.startswith("drawer: FAILED, evaluation limit")


def test_srdf_is_written(run: RunCommand) -> None:
    result = run("srdf husky_ur5e --output husky.srdf --samples 50 --seed 1")
    assert result.code == 0
    assert "husky.srdf" in result.out
    assert "<disable_collisions" in Path("husky.srdf").read_text(encoding="utf-8")


def test_bench_door_records_every_trial(run: RunCommand) -> None:
    assert run("bench door --trials 1 --seed 3 --quiet --json door.json").code == 0
    result = json.loads(Path("door.json").read_text(encoding="utf-8"))
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


def test_saved_plan_is_executed(run: RunCommand) -> None:
    plan_drawer().save("plan.npz")
    result = run("simulate plan.npz --html page.html --json data.json --grasp friction")
    assert result.code == 0
    for text in ("drawer in physics: ok", "slips by", "wrote page.html"):
        assert text in result.out
    assert "in physics" in Path("page.html").read_text(encoding="utf-8")
    assert json.loads(Path("data.json").read_text(encoding="utf-8"))["ok"] is True
