"""Tests the comparison of initialization methods, with a fake planner."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.experiments import run_experiment
from helpers.fake_plan import make_fake_plan, replace_metrics
from helpers.markdown import parse_cells

import vkc_pin as vkc
from vkc_pin import Report
from vkc_pin.experiments import initialization
from vkc_pin.experiments.initialization import COMPARED_INITIALIZATIONS, STEPWISE, TARGET


def solve(scene: vkc.Scene, spec: Mapping[str, Any]) -> vkc.Plan:
    """Fail with "stationary", and with "interpolated" from odd starts."""
    method, number = spec["method"], spec["number"]
    success = method != "stationary" and not (method == "interpolated" and number % 2)
    stepwise = method == STEPWISE
    k = 0 if stepwise else COMPARED_INITIALIZATIONS.index(method)
    metrics = {
        "planning_time": 3.0 if stepwise else 1.0 + number + 0.25 * k,
        "base_path_length": 4.0 + number + stepwise,
        "base_path_length_l1": 6.0 + number,
        "arm_path_length": 7.0 + number * stepwise,
    }
    plan = make_fake_plan(scene)
    status, report = ("success", Report()) if success else ("rejected", plan.report)
    return replace_metrics(plan, metrics, status=status, report=report, seed=spec["seed"])


def run(out: Path, **changes: Any) -> dict[str, Any]:
    settings = {"starts": 3, "repeats": 2, "seed": 5, "scenes": ["door"], "solve": solve}
    return initialization.run(out=out, progress=False, **{**settings, **changes})


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bench") / "out"
    run(folder)
    return folder


@pytest.fixture(scope="module")
def result(out: Path) -> dict[str, Any]:
    return run(out)  # runs no trial again


def test_trials_are_recorded(result: dict[str, Any]) -> None:
    trials = result["trials"]
    numbers = [(n, r) for n in range(3) for r in range(2)]
    expected = [(m, *at) for m in COMPARED_INITIALIZATIONS for at in numbers]
    expected += [(STEPWISE, n, 0) for n in range(3)]
    assert sorted((t["method"], t["number"], t["repeat"]) for t in trials) == sorted(expected)
    seeds = {t["number"]: t["seed"] for t in trials if t["repeat"] == 0}
    assert len(set(seeds.values())) == len(seeds), "each start has its own random seed"
    for t in trials:
        assert t["seed"] == seeds[t["number"]] + t["repeat"]
        assert t["perturbation"] == (0.05 if t["repeat"] else 0.0)
        assert t["success"] == (t["status"] == "success") == (not t["violations"])
    meta = {"benchmark": "initialization", "seed": 5, "starts": 3, "repeats": 2}
    assert {name: result["meta"][name] for name in meta} == meta
    assert result["meta"]["target"] == list(TARGET)


def test_starts_are_shared_by_methods_and_selections(
    result: dict[str, Any], tmp_path: Path
) -> None:
    starts = [{tuple(t["start"]) for t in result["trials"] if t["number"] == n} for n in range(3)]
    assert [len(start) for start in starts] == [1, 1, 1]
    assert len(set.union(*starts)) == 3
    fewer = run(tmp_path, starts=2, repeats=1, methods=["astar"])["trials"]
    assert [t["method"] for t in fewer] == ["astar", "astar"], "stepwise is compared with auto"
    assert [tuple(t["start"]) for t in fewer] == [*starts[0], *starts[1]]


def test_tables_equal_values_computed_by_hand(out: Path, result: dict[str, Any]) -> None:
    text = (out / "table.md").read_text(encoding="utf-8")
    assert text == initialization.format_results(result)
    blocks = [block for block in text.split("\n\n") if block.startswith("|")]
    methods, compared = (parse_cells(block.replace("\\|", "/"))[1:] for block in blocks)
    # Starts 0, 1, 2, each twice: "stationary" takes 1, 1, 2, 2, 3, 3 s.
    failed = "rejected (penetration)"
    assert methods == [
        ["door", "stationary", "0 of 6", "2.00", "3.00", "–", "–", "0", f"{failed} 6"],
        ["door", "interpolated", "4 of 6", "2.25", "3.25", "5.00", "7.00", "0", f"{failed} 2"],
        ["door", "astar", "6 of 6", "2.50", "3.50", "5.00", "7.00", "0", "none"],
        ["door", "rrt", "6 of 6", "2.75", "3.75", "5.00", "7.00", "0", "none"],
        ["door", "auto", "6 of 6", "3.00", "4.00", "5.00", "7.00", "0", "none"],
        ["door", STEPWISE, "3 of 3", "3.00", "3.00", "6.00", "8.00", "0", "none"],
    ]
    assert [row[-3:] for row in compared] == [
        ["5.00 (4.50–5.50)", "6.00 (5.50–6.50)", "3 of 3"],
        ["7.00 (6.50–7.50)", "7.00 (6.50–7.50)", "0 of 3"],
        ["7.00 (7.00–7.00)", "8.00 (7.50–8.50)", "2 of 3"],
    ]
    assert (out / "success.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.long
def test_planned_trial_is_recorded(tmp_path: Path) -> None:
    arguments = "initialization --starts 1 --scenes init_1 --methods astar --jobs 1"
    table, (trial,) = run_experiment(arguments, tmp_path)
    assert (trial["key"], trial["method"]) == ("init_1/0000/000/astar", "astar")
    assert trial["success"] is True, (trial["status"], trial["violations"])
    assert trial["initialization"].startswith("astar")
    assert 0.0 <= trial["clearance"] < 0.02, "the stick is near the table and the cube"
    assert 0.0 <= trial["closure_error"] <= 1e-3
    length, sides = trial["base_path_length"], trial["base_path_length_l1"]
    assert length <= sides <= np.sqrt(2.0) * length
    stages = [trial[name] for name in trial if name.startswith("time_")]
    assert min(stages) >= 0.0
    assert 0.0 < sum(stages) <= trial["planning_time"]
    assert trial["waypoints"] == 82, "two times 40 segments, the start, and a pause for the gripper"
    assert f"| init_1: no obstacle | astar | 1 of 1 | {trial['planning_time']:.2f} |" in table
