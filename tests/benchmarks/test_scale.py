from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.fake_plan import fake_plan, with_metrics

import vkc_pin as vkc
from vkc_pin.benchmarks import scale
from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.harness.limits import MAX_EVALUATIONS
from vkc_pin.benchmarks.scale import AXES, crowded, refined
from vkc_pin.cli import main
from vkc_pin.errors import InputError
from vkc_pin.validation.report import Report, Violation

BLAME = Violation(
    "penetration",
    "forearm_link – box_7",
    waypoint=3,
    time=1.0,
    amount=0.01,
    unit="m",
    detail="overlap by 10 mm",
)
TIMES = {"initialization": 0.3, "coal": 0.1, "casadi": 0.2, "ipopt": 0.15, "validation": 0.05}


@pytest.fixture(autouse=True)
def same_sources(monkeypatch: pytest.MonkeyPatch) -> None:
    """The sources may be worked on while the tests run."""
    monkeypatch.setattr(runner, "_sources", lambda: "abc")


@pytest.fixture
def planned(
    monkeypatch: pytest.MonkeyPatch,
) -> list[tuple[vkc.Scene, list[vkc.Step], dict[str, Any]]]:
    """What was asked of the planner, which plans nothing here: it takes longer from every start, and fails among 300 from one."""
    asked: list[tuple[vkc.Scene, list[vkc.Step], dict[str, Any]]] = []

    def plan(scene: vkc.Scene, steps: list[vkc.Step], **how: Any) -> vkc.Plan:
        asked.append((scene, steps, how))
        count, number = len(scene.obstacle_names), (len(asked) - 2) // 4
        metrics = {
            **{f"time_{name}": value for name, value in TIMES.items()},
            **{
                "planning_time": 1.0 + number + count / 1000.0,
                "iterations": 60.0 + number,
                "rounds": 4.0,
                "build_time": 0.0,
            },
            **{
                "base_path_length": 2.0,
                "base_path_length_l1": 2.5,
                "arm_path_length": 7.0,
                "clearance": 0.02,
                "closure_error": 1e-7,
            },
        }
        status = "rejected" if count == 300 and number == 1 else "success"
        report = Report((BLAME,)) if status == "rejected" else Report()
        return with_metrics(fake_plan(scene), metrics, status=status, validation=report)

    monkeypatch.setattr(scale, "plan", plan)
    scale._warm.cache_clear()
    return asked


def test_obstacles_are_the_same_and_more() -> None:
    few, some, many = (crowded(count) for count in (10, 30, 300))
    assert [len(scene.obstacle_names) for scene in (few, some, many)] == [10, 30, 300]
    assert some.obstacle_names[:10] == few.obstacle_names
    assert many.document["obstacles"][:30] == some.document["obstacles"]
    assert many.start_clearance() == some.start_clearance()
    assert crowded(30, seed=1).document["obstacles"] != some.document["obstacles"]
    assert {label for label in few.obstacle_labels if "wall" in label} >= {
        "wall_west",
        "wall_above_door",
        "hall_wall",
    }


def test_from_every_start_all_numbers_take_turns() -> None:
    trials = scale.specify(starts=3, seed=4, counts=(30, 100))
    assert [(t["number"], t["obstacles"]) for t in trials] == [
        (n, count) for n in range(3) for count in (30, 100)
    ]
    assert [t["key"] for t in trials] == sorted(t["key"] for t in trials)
    bases = [t["base"] for t in trials]
    assert bases[::2] == bases[1::2]
    assert len({tuple(base) for base in bases}) == 3
    more = scale.specify(
        starts=2, seed=4, counts=(10,)
    )  # neither the numbers nor how many starts there are matter to a start
    assert [t["base"] for t in more] == bases[:4:2]
    assert scale.specify(starts=1, seed=5, counts=(10,))[0]["base"] != bases[0]
    for base in bases:
        assert crowded(1000).with_start(base=base).start_clearance() >= 0.03


def test_trials_and_table(
    planned: list[Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [
        "bench",
        "scale",
        "--starts",
        "3",
        "--seed",
        "2",
        "--counts",
        "300",
        "10",
        "30",
        "100",
        "30",
        "--quiet",
    ]
    assert main([*command, "--out", str(tmp_path)]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {
        *("results.json", "results.csv", "table.md", "scale.png", "trials.jsonl"),
    }
    (_, steps, how), *rest = planned
    assert len(rest) == 12  # and one before, to pay for what is built once
    assert [(step.object, step.joints) for step in steps] == [("door", {"hinge": 1.2})]
    assert (how["seed"], how["max_evaluations"]) == (2, MAX_EVALUATIONS)
    result = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    meta, trials = result["meta"], result["trials"]
    assert (meta["benchmark"], meta["seed"], meta["starts"]) == ("scale", 2, 3)
    assert (meta["of"], meta["counts"]) == ("obstacles", [10, 30, 100, 300])
    assert {"processor", "cores"} <= set(meta["machine"])
    assert {"pin", "coal", "casadi"} <= set(meta["versions"])
    assert [(t["number"], t["obstacles"]) for t in trials] == [
        (n, count) for n in range(3) for count in (10, 30, 100, 300)
    ]
    for (scene, _, _), t in zip(rest, trials, strict=True):
        assert (t["scene"], t["obstacles"]) == (f"door_{t['obstacles']}", len(scene.obstacle_names))
        np.testing.assert_allclose(t["start"], scene.start, atol=1e-9)
    with (tmp_path / "results.csv").open(encoding="utf-8", newline="") as stream:
        assert [row["obstacles"] for row in csv.DictReader(stream)] == [
            str(t["obstacles"]) for t in trials
        ]

    table = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert table in capsys.readouterr().out
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in table.splitlines()
        if line.startswith("|")
    ]
    head, rows = rows[0], rows[2:]
    assert head[4] == "times that of 30"
    for count, good, row in zip((10, 30, 100, 300), (3, 3, 3, 2), rows, strict=True):
        ratio = np.median([(1.0 + n + count / 1000.0) / (1.03 + n) for n in range(3)])
        late = np.percentile([1.0, 2.0, 3.0], 95) + count / 1000.0
        expected = [2.0 + count / 1000.0, late, ratio, *TIMES.values()]
        assert row == [str(count), f"{good} of 3", *(f"{value:.2f}" for value in expected), "61"]
    assert main([*command, "--out", str(tmp_path)]) == 0  # nothing is left to do
    assert len(planned) == 13


def test_segments_take_turns_too(
    planned: list[Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [
        "bench",
        "scale",
        "--starts",
        "2",
        "--of",
        "segments",
        "--counts",
        "160",
        "80",
        "--quiet",
        "--out",
        str(tmp_path),
    ]
    assert main(command) == 0
    _, *rest = planned
    assert [how["options"] for _, _, how in rest] == [refined(80), refined(160)] * 2
    assert all(steps[0].joints == {"hinge": 0.6} for _, steps, _ in rest)
    assert {len(scene.obstacle_names) for scene, _, _ in rest} == {AXES["obstacles"].usual}
    trials = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))["trials"]
    assert [(t["number"], t["segments"]) for t in trials] == [(0, 80), (0, 160), (1, 80), (1, 160)]
    table = capsys.readouterr().out
    assert "times that of 80" in table
    assert "| 160 | 2 of 2 |" in table


def test_refined_options_divide_the_same_time() -> None:
    usual = vkc.Options()
    for segments in (4, 20, 76, 320):
        own = refined(segments)
        phases = [(o.reach_waypoints, o.turn_waypoints, o.move_waypoints) for o in (own, usual)]
        assert sum(phases[0]) == segments
        assert own.dt * segments == pytest.approx(usual.dt * sum(phases[1]))
        if segments >= 20:
            np.testing.assert_allclose(
                np.array(phases[0]) / segments, np.array(phases[1]) / sum(phases[1]), atol=0.05
            )
    assert refined(76) == usual


def test_errors_have_no_time_and_a_ratio_needs_30_obstacles(
    planned: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = scale.plan

    def plan(scene: vkc.Scene, *given: Any, **how: Any) -> vkc.Plan:
        if len(scene.obstacle_names) == 12:
            raise RuntimeError("broken")
        return real(scene, *given, **how)

    monkeypatch.setattr(scale, "plan", plan)
    result = scale.run(starts=2, seed=0, out=tmp_path, counts=(11, 12), progress=False)
    assert [t["status"] for t in result["trials"]] == ["success", "error"] * 2
    line, broken = scale.report(result).split("| --- |")[1].splitlines()[1:3]
    assert line.startswith("| 11 | 2 of 2 | 1.")
    assert line.split("|")[5].strip() == "–"
    assert {cell.strip() for cell in broken.strip("|").split("|")[2:]} == {"–"}
    assert broken.startswith("| 12 | 0 of 2 |")
    assert (tmp_path / "scale.png").stat().st_size > 10_000


def test_what_cannot_be_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for of, counts in (("obstacles", ()), ("obstacles", (0, 10)), ("segments", (3, 20))):
        with pytest.raises(InputError, match="counts"):
            scale.run(starts=1, seed=0, out=tmp_path, of=of, counts=counts, progress=False)
    with pytest.raises(InputError, match="obstacles or segments"):
        scale.run(starts=1, seed=0, out=tmp_path, of="doors", progress=False)
    stopped = dataclasses.replace(fake_plan(crowded(10)), status="interrupted")
    monkeypatch.setattr(scale, "plan", lambda *_, **__: stopped)
    scale._warm.cache_clear()
    with pytest.raises(
        KeyboardInterrupt, match="0 of 5 trials"
    ):  # also by Ctrl-C before the first trial
        scale.run(starts=1, seed=0, out=tmp_path, progress=False)
