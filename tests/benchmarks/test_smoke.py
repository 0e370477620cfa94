"""The experiments from the command line, for real, on two starts."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vkc_pin.benchmarks.initialization import TARGET
from vkc_pin.cli import main
from vkc_pin.planning.plan import Plan
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.scene import load_scene
from vkc_pin.world.trajectory.world_model import World

FIELDS = {
    *(
        "key",
        "scene",
        "method",
        "number",
        "repeat",
        "perturbation",
        "start",
        "seed",
        "success",
        "status",
        "planning_time",
    ),
    *(
        "base_path_length",
        "base_path_length_l1",
        "arm_path_length",
        "clearance",
        "closure_error",
        "iterations",
        "rounds",
        "evaluations",
        "waypoints",
    ),
    *("initialization", "build_time", "failed_constraint", "violations"),
    *(
        f"time_{part}"
        for part in ("initialization", "coal", "casadi", "ipopt", "retiming", "validation")
    ),
    "commit",
    "wall_time",
}


def check(trial: dict[str, Any], method: str, number: int) -> None:
    """A record must agree with itself."""
    assert set(trial) == FIELDS
    assert trial["key"] == f"init_1/{number:04d}/000/{method}"
    assert (trial["scene"], trial["method"], trial["number"], trial["repeat"]) == (
        "init_1",
        method,
        number,
        0,
    )
    assert trial["success"] is True, (trial["status"], trial["violations"])
    assert (trial["status"], trial["failed_constraint"], trial["violations"]) == (
        "success",
        None,
        [],
    )
    assert 0.0 <= trial["clearance"] < 0.02  # the stick is near the table and the cube
    assert 0.0 <= trial["closure_error"] <= 1e-3
    assert (
        trial["base_path_length"]
        <= trial["base_path_length_l1"]
        <= np.sqrt(2.0) * trial["base_path_length"]
    )
    assert trial["arm_path_length"] > 0.5
    start, stick = (
        np.array(trial["start"]),
        load_scene("init_1").objects["stick"].placement.translation,
    )
    # From the start to within reach of the stick, and from there to within reach of the cube; the
    # stick makes the arm longer.
    reach = 1.4
    farther = (
        np.linalg.norm(start[:2] - stick[:2])
        - reach
        + np.linalg.norm(stick[:2] - TARGET[:2])
        - 2 * reach
        - 0.5
    )
    assert farther > 2.0
    assert trial["base_path_length"] > farther
    parts = [trial[name] for name in trial if name.startswith("time_")]
    assert all(part >= 0.0 for part in parts)
    assert 0.0 < sum(parts) <= trial["planning_time"]
    assert trial["waypoints"] == 82  # two times 40 segments, the start, and a pause for the gripper
    assert trial["iterations"] >= trial["rounds"] >= 1


def test_every_experiment_takes_a_scheduler(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is asked for reaches the engine, before a trial is run."""
    asked = []

    def results(function: Any, tasks: Any, *, scheduler: str | None, **others: Any) -> Any:
        asked.append(scheduler)
        raise KeyboardInterrupt

    monkeypatch.setattr("vkc_pin.benchmarks.harness.runner.run_tasks", results)
    names = [
        "initialization",
        "baselines",
        "household",
        "chores",
        "scale",
        "bases",
        "gap",
        "ablation",
        "spread",
        "first-seed",
        "impossible",
    ]
    for name in [*names, "random", "execution"]:
        pytest.importorskip("mujoco") if name == "execution" else None
        command = [
            "bench",
            name,
            "--scheduler",
            "tcp://here:1",
            "--out",
            str(tmp_path / name),
            "--quiet",
        ]
        assert main(command) == 130, name
    assert asked == ["tcp://here:1"] * 13


def test_an_experiment_on_a_scheduler_of_somebody_else(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    command = ["bench", "gap", "--trials", "2", "--quiet", "--out"]
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address=None
    ) as cluster:
        assert (
            main([*command, str(tmp_path / "there"), "--scheduler", cluster.scheduler_address]) == 0
        )
    assert main([*command, str(tmp_path / "here")]) == 0
    found = [
        json.loads((tmp_path / where / "results.json").read_text())["trials"]
        for where in ("there", "here")
    ]
    assert [
        [trial[name] for name in ("key", "success", "evaluations", "base_path_length")]
        for trial in found[0]
    ] == [
        [trial[name] for name in ("key", "success", "evaluations", "base_path_length")]
        for trial in found[1]
    ]


def test_initialization(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "tmp"
    command = [
        "bench",
        "initialization",
        "--starts",
        "2",
        "--scenes",
        "init_1",
        "--methods",
        "astar",
        "--jobs",
        "1",
        "--quiet",
    ]
    assert main([*command, "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert {path.name for path in out.iterdir()} == {
        "results.json",
        "results.csv",
        "table.md",
        "success.png",
        "trials.jsonl",
    }

    result = json.loads((out / "results.json").read_text(encoding="utf-8"))
    assert (result["meta"]["scenes"], result["meta"]["methods"], result["meta"]["starts"]) == (
        ["init_1"],
        ["astar"],
        2,
    )
    assert (
        sum(session["trials"] for session in result["meta"]["sessions"])
        == len(result["trials"])
        == 2
    )
    for number, trial in enumerate(result["trials"]):
        check(trial, "astar", number)
        assert trial["initialization"].startswith("astar")
    assert result["trials"][0]["start"] != result["trials"][1]["start"]

    with (out / "results.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["key"] for row in rows] == [trial["key"] for trial in result["trials"]]
    for row, trial in zip(rows, result["trials"], strict=True):
        assert set(row) == FIELDS
        assert (row["success"], row["status"], row["failed_constraint"]) == ("true", "success", "")
        for name in ("planning_time", "base_path_length", "arm_path_length", "start"):
            assert json.loads(row[name]) == trial[name]

    table = (out / "table.md").read_text(encoding="utf-8")
    assert table in said.out
    (line,) = [line for line in table.splitlines() if line.startswith("| init_1")]
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert cells[:3] == ["init_1: no obstacle", "astar", "2 of 2"]
    medians = (
        np.median([trial[name] for trial in result["trials"]])
        for name in ("planning_time", "base_path_length", "arm_path_length")
    )
    assert [cells[3], cells[5], cells[6]] == [f"{value:.2f}" for value in medians]
    assert cells[7:9] == ["0", "none"]
    assert "step after step" not in table  # that is compared with "auto" only
    picture = (out / "success.png").read_bytes()
    assert picture.startswith(b"\x89PNG\r\n\x1a\n")
    assert len(picture) > 5000

    # The same command again has nothing left to do.
    before = {
        name: (out / name).read_bytes()
        for name in ("trials.jsonl", "results.json", "results.csv", "table.md")
    }
    assert main([*command, "--out", str(out)]) == 0
    assert {name: (out / name).read_bytes() for name in before} == before
    # Another experiment in this folder is refused.
    assert main([*command, "--seed", "1", "--out", str(out)]) == 2
    assert "seed" in capsys.readouterr().err


@pytest.mark.long
def test_auto_is_compared_with_step_after_step(tmp_path: Path) -> None:
    command = [
        "bench",
        "initialization",
        "--starts",
        "1",
        "--scenes",
        "init_1",
        "--methods",
        "auto",
        "--jobs",
        "1",
        "--quiet",
    ]
    assert main([*command, "--out", str(tmp_path)]) == 0
    trials = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))["trials"]
    assert [trial["method"] for trial in trials] == ["auto", "step after step"]
    for trial in trials:
        check(trial, trial["method"], 0)
    assert trials[0]["start"] == trials[1]["start"]
    compared = (
        (tmp_path / "table.md")
        .read_text(encoding="utf-8")
        .split("## One problem against step after step")[1]
    )
    for name, field in (("base [m]", "base_path_length"), ("arm [rad]", "arm_path_length")):
        (line,) = [
            line
            for line in compared.splitlines()
            if line.startswith(f"| init_1: no obstacle | {name} |")
        ]
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        assert [cell.split(" ")[0] for cell in cells[2:4]] == [
            f"{trial[field]:.2f}" for trial in trials
        ]
        assert cells[4] == f"{int(trials[0][field] < trials[1][field] - 1e-6)} of 1"


@pytest.mark.long
def test_baselines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = [
        "bench",
        "baselines",
        "--trials",
        "2",
        "--tasks",
        "drawer",
        "--methods",
        "B1",
        "VKC",
        "--jobs",
        "1",
        "--quiet",
    ]
    command += ["--save-failures", "--out", str(tmp_path)]
    assert main(command) == 0
    table = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert table in capsys.readouterr().out
    trials = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))["trials"]
    assert [t["key"] for t in trials] == [
        f"drawer/{n:04d}/{method}" for n in (0, 1) for method in ("B1", "VKC")
    ]
    for t in trials:
        own = {"peak_velocity", "peak_acceleration", "duration", "cold_time", "warm_time"} | (
            {"time_following"} if t["method"] == "B1" else set()
        )
        assert set(t) == FIELDS - {"repeat", "perturbation"} | own
        assert t["success"] == (t["status"] == "success") == (not t["violations"])
        assert t["success"] or t["method"] == "B1", t["violations"]
        assert (t["scene"], t["seed"]) == ("drawer", t["number"])
        assert 0.0 < sum(t[name] for name in t if name.startswith("time_")) <= t["planning_time"]
        assert (tmp_path / f"failures/drawer_{t['number']:04d}_{t['method']}.npz").is_file() == (
            not t["success"]
        )
        assert (
            f"| drawer | {t['method']} | {sum(o['success'] for o in trials if o['method'] == t['method'])} of 2 |"
            in table
        )
        if not t["success"]:
            continue
        assert (
            t["base_path_length"]
            <= t["base_path_length_l1"]
            <= np.sqrt(2.0) * t["base_path_length"]
        )
        # From the start to within reach of the drawer, which is at x = 4, y = 2.5.
        assert t["base_path_length"] > np.linalg.norm(np.array(t["start"][:2]) - [4.0, 2.5]) - 1.9
        assert 0.0 < t["peak_velocity"] <= np.pi
        assert 0.0 < t["peak_acceleration"] <= 1.4 + 1e-3  # the limit
        assert t["peak_velocity"] * 6 * t["duration"] > t["arm_path_length"] > 1.0
    assert trials[0]["start"] == trials[1]["start"] != trials[2]["start"] == trials[3]["start"]

    # The motions in the picture are those of the trial.
    both = [n for n in (0, 1) if all(t["success"] for t in trials if t["number"] == n)]
    shown = {path.name: Plan.load(path) for path in (tmp_path / "shown").iterdir()} if both else {}
    assert set(shown) == (
        {f"drawer_{both[0]:04d}_{method}.npz" for method in ("B1", "VKC")} if both else set()
    )
    for t in trials:
        plan = shown.get(f"drawer_{t['number']:04d}_{t['method']}.npz")
        if plan is not None:
            assert validate(plan.scene, plan.steps, plan.trajectory, plan.options).ok
            assert plan.trajectory.column("drawer.slide")[-1] == pytest.approx(0.6, abs=5e-3)
            for name, value in plan.trajectory.metrics().items():
                assert t[name] == pytest.approx(value, rel=1e-3), name
    for name in ("drawer.png", "drawer_joints.png")[: 1 + bool(both)]:
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG\r\n\x1a\n")

    before = {
        path.name: path.read_bytes()
        for path in tmp_path.iterdir()
        if path.suffix in (".json", ".jsonl", ".csv", ".md")
    }
    assert main(command) == 0  # nothing is left to do
    assert {name: (tmp_path / name).read_bytes() for name in before} == before


def test_scale(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = [
        "bench",
        "scale",
        "--starts",
        "2",
        "--counts",
        "10",
        "40",
        "--jobs",
        "1",
        "--quiet",
        "--out",
        str(tmp_path),
    ]
    assert main(command) == 0
    table = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert table in capsys.readouterr().out
    trials = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))["trials"]
    assert [t["key"] for t in trials] == [
        f"{n:04d}/{count:06d}" for n in (0, 1) for count in (10, 40)
    ]
    for t in trials:
        assert set(t) == FIELDS - {"repeat", "perturbation", "wall_time"} | {"obstacles"}
        assert t["success"] == (t["status"] == "success") == (not t["violations"])
        assert t["success"], t["violations"]
        assert (
            t["base_path_length"] > 1.5 - t["start"][0]
        )  # from the start to within reach of the door, which is at x = 2.5
        assert 0.0 < sum(t[name] for name in t if name.startswith("time_")) <= t["planning_time"]
    assert trials[0]["start"] == trials[1]["start"] != trials[2]["start"] == trials[3]["start"]
    for count in (10, 40):
        median = np.median([t["planning_time"] for t in trials if t["obstacles"] == count])
        assert f"| {count} | 2 of 2 | {median:.2f} |" in table
    assert (tmp_path / "scale.png").read_bytes().startswith(b"\x89PNG\r\n\x1a\n")


@pytest.mark.long
def test_household(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = [
        "bench",
        "household",
        "--trials",
        "1",
        "--tasks",
        "cup",
        "cabinet",
        "--methods",
        "B1",
        "VKC",
        "--jobs",
        "1",
    ]
    assert main([*command, "--quiet", "--out", str(tmp_path)]) == 0
    table = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert table in capsys.readouterr().out
    trials = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))["trials"]
    assert [t["key"] for t in trials] == [
        f"{task}/0000/{method}" for task in ("cabinet", "cup") for method in ("B1", "VKC")
    ]
    for t in trials:
        assert t["success"] == (t["status"] == "success") == (not t["violations"])
        assert t["success"] or t["method"] == "B1", t["violations"]
        assert ("placed" in t) == (t["scene"] == "cup")
        assert (tmp_path / f"shown/{t['scene']}_0000_{t['method']}.npz").is_file()
        if not t["success"]:
            continue
        found = Plan.load(tmp_path / f"shown/{t['scene']}_0000_{t['method']}.npz")
        assert validate(found.scene, found.steps, found.trajectory, found.options).ok
        if t["scene"] == "cup":
            world = World(found.scene)
            at, *_, end = (
                world.get_placement("cup", row) for row in world.compute_positions(found.trajectory)
            )
            np.testing.assert_allclose(at.translation, t["placed"]["cup"][:3], atol=1e-6)
            np.testing.assert_allclose(end.translation, [-0.6, -1.6, 0.751], atol=2e-3)
            assert end.rotation[2, 2] > np.cos(2e-3)
        else:
            assert found.trajectory.column("cabinet.hinge")[-1] == pytest.approx(0.4, abs=5e-3)
        assert t["base_path_length"] > 1.0
    for name in (
        "success",
        "base_path_length",
        "arm_path_length",
        "planning_time",
        "cup_joints",
        "cabinet_joints",
    ):
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
        assert f"]({name}.png)" in table


def test_impossible(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "impossible", "--problems", "4", "--quiet", "--out", str(tmp_path)]) == 0
    table = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert table in capsys.readouterr().out
    trials = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))["trials"]
    assert [t["kind"] for t in trials] == [
        "closed wall",
        "fence round the start",
        "fence round the goal",
        "gap too narrow",
    ]
    for t in trials:
        assert (t["success"], t["explained"], t["proven"]) == (False, True, True)
        assert "proven: " in t["notes"][0]
        assert t["notes"][0] in table
        assert t["wall_time"] > 0.0
