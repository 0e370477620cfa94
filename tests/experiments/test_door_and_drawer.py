"""Tests the comparison of planning methods, with a fake planner."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.fake_plan import make_fake_plan, replace_metrics
from helpers.markdown import parse_cells

import vkc_pin as vkc
from vkc_pin import Report
from vkc_pin.experiments import door_and_drawer
from vkc_pin.experiments.comparison import COMPARED_PLANNERS, choose_shown_trial, format_results
from vkc_pin.planning.plan import PlanningStatistics

SUCCESSES = {"B1": {2, 3}, "B2": {1, 2}, "VKC": {0, 1, 2}}
"""Method → numbers of the starts from which `solve` succeeds."""


def solve(scene: vkc.Scene, spec: Mapping[str, Any]) -> vkc.Plan:
    method, number = spec["method"], spec["number"]
    success, k = number in SUCCESSES[method], COMPARED_PLANNERS.index(method)
    plan = make_fake_plan(scene)
    metrics = {
        **plan.trajectory.metrics(),
        **PlanningStatistics(1.0 + number + k, 0.5, 12, 3).to_metrics(),
        "base_path_length": 4.0 + number - k,
        "arm_path_length": 7.0,
        "clearance": np.inf,
        "closure_error": 1e-4,
    }
    outcome = Report() if success else plan.report
    status = "success" if success else "collision"
    return replace_metrics(plan, metrics, status=status, report=outcome, seed=spec["seed"])


def run(out: Path, **changes: Any) -> dict[str, Any]:
    settings = {"trials": 3, "seed": 5, "tasks": ["door"], "solve": solve, "progress": False}
    return door_and_drawer.run(out=out, **{**settings, **changes})


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bench") / "out"
    run(folder, save_failures=True)
    return folder


@pytest.fixture(scope="module")
def result(out: Path) -> dict[str, Any]:
    return run(out, save_failures=True)  # runs no trial again


def list_files(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} if folder.is_dir() else set()


def test_trials_are_recorded(result: dict[str, Any]) -> None:
    trials = result["trials"]
    assert [(t["number"], t["method"]) for t in trials] == [
        (n, m) for n in range(3) for m in COMPARED_PLANNERS
    ]
    specify = door_and_drawer.COMPARISON.specify
    (base,) = (t["base"] for t in specify(trials=1, seed=5, tasks=["door"], methods=["VKC"]))
    np.testing.assert_allclose(trials[0]["start"][:3], base, atol=1e-8)
    for t in trials:
        assert (t["scene"], t["seed"]) == ("door", 5 + t["number"])
        assert t["success"] == (t["number"] in SUCCESSES[t["method"]])
        assert t["duration"] == pytest.approx(6.0)
    expected = {"benchmark": "baselines", "seed": 5, "starts": 3, "tasks": ["door"]}
    expected |= {"methods": list(COMPARED_PLANNERS), "scenes": {"door": "corridor_door"}}
    expected |= {"goals": {"door": {"door.hinge": 1.5}}}
    assert {name: result["meta"][name] for name in expected} == expected


def parse_table(text: str, title: str) -> list[list[str]]:
    """Return the rows of the table in a section."""
    section = text.split(f"## {title}\n")[1].split("\n## ")[0].replace("\\|", "/")
    return parse_cells("\n".join(line for line in section.splitlines() if line.startswith("|")))[1:]


def test_tables_equal_values_computed_by_hand(out: Path) -> None:
    text = (out / "table.md").read_text(encoding="utf-8")
    assert parse_table(text, "Success") == [
        ["door", "B1", "1 of 3", "33", "6–79", "0", "collision (penetration) 2"],
        ["door", "B2", "2 of 3", "67", "21–94", "0", "collision (penetration) 1"],
        ["door", "VKC", "3 of 3", "100", "44–100", "0", "none"],
    ]
    # B1 takes 1, 2 and 3 s, VKC 3, 4 and 5 s. The 95th percentile of 1, 2, 3 is 2 + 0.9.
    times = parse_table(text, "Planning time")
    assert times[0] == ["all trials", "door", "B1", "3", "2.00", "2.90", "2.00", "1.00", "0.50"]
    assert times[4] == ["successes", "door", "B2", "2", "3.50", "3.95", "3.50", "0.71", "0.88"]
    common = "Path lengths, peaks and durations where all methods succeed"
    assert "all methods succeed: 1 of 3 (door)." in text
    base = ["door", "base [m]", "6.00 ± –; 6.00", "5.00 ± –; 5.00", "4.00 ± –; 4.00"]
    assert parse_table(text, common)[0] == base
    pairs = parse_table(text, "VKC against each baseline")
    assert pairs[0] == ["door", "base [m]", "B1", "4.00", "6.00", "1 of 1"]
    assert pairs[6] == ["door", "planning time [s]", "B1", "5.00", "3.00", "0 of 1"]
    assert pairs[7] == ["door", "base [m]", "B2", "3.50", "4.50", "2 of 2"]
    own = parse_table(text, "Path lengths, peaks and durations over each method's own successes")
    assert own[0] == ["door", "n", "1", "2", "3"]
    assert own[1][2:] == ["6.00 ± –; 6.00", "4.50 ± 0.71; 4.50", "3.00 ± 1.00; 3.00"]
    assert [(row[1], row[2], row[5]) for row in parse_table(text, "Failures")] == [
        (str(n), method, f"`failures/door_000{n}_{method}.npz`")
        for n, method in ((0, "B1"), (0, "B2"), (1, "B1"))
    ]
    for picture in ("door.png", "door_joints.png"):
        assert f"]({picture})" in text
        assert (out / picture).read_bytes().startswith(b"\x89PNG")
    assert "Motions of trial 2" in text
    assert "9 trials, 1 at a time" in text.splitlines()[-1]


def test_errors_have_no_times_and_no_path_lengths(result: dict[str, Any]) -> None:
    error = {"success": False, "status": "error", "violations": ["ValueError: no"]}
    odd = {"key": "door/0003/B1", "scene": "door", "method": "B1", "number": 3, **error}
    trials = [*result["trials"], odd]
    text = format_results({**result, "trials": trials}, {"door": "open it"}, title="Odd")
    assert text.startswith("# Odd\n\n`door`: open it. 3 random starts")
    for part in ("| door | B1 | 1 of 4 | 25 |", "error 1", "| all trials | door | B1 | 3 | 2.00 |"):
        assert part in text
    assert "1 of 4 (door)" in text


def test_failures_are_saved(out: Path, result: dict[str, Any]) -> None:
    assert list_files(out / "failures") == {
        "door_0000_B1.npz",
        "door_0000_B2.npz",
        "door_0001_B1.npz",
    }
    saved = vkc.Plan.load(out / "failures" / "door_0001_B1.npz")
    (trial,) = [t for t in result["trials"] if t["key"] == "door/0001/B1"]
    assert saved.claimed is not None
    assert [str(v) for v in saved.claimed.violations] == trial["violations"]
    assert (saved.status, saved.seed) == ("collision", 6)
    np.testing.assert_allclose(saved.scene.start, trial["start"], atol=1e-8)


@pytest.mark.long
def test_failures_are_planned_again_to_be_saved(tmp_path: Path) -> None:
    run(tmp_path)
    assert list_files(tmp_path / "failures") == set()

    def succeed(scene: vkc.Scene, spec: Mapping[str, Any]) -> vkc.Plan:
        return solve(scene, {**spec, "number": 2})

    run(tmp_path, solve=succeed, save_failures=True)
    text = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert list_files(tmp_path / "failures") == set(), "the repeated trials succeed"
    assert "## Failures" not in text
    assert "| door | B1 | 1 of 3 |" in text, "recorded outcomes are unchanged"
    run(tmp_path, save_failures=True)
    assert "door_0001_B1.npz" in list_files(tmp_path / "failures")


@pytest.mark.parametrize(
    ("successes", "expected"),
    [
        ({"B1": {1, 2}, "B2": {2, 3}, "VKC": {0, 1, 2, 3}}, 2),
        ({"B1": {1}, "B2": {0}, "VKC": {0, 1}}, 0),
        ({"B1": set(), "B2": {1}, "VKC": {0, 1}}, 1),
        ({"B1": {0, 1}, "B2": {0, 1}, "VKC": {2}}, 2),
        ({"B1": set(), "B2": set(), "VKC": set()}, None),
    ],
)
def test_shown_trial_has_most_successes(
    successes: dict[str, set[int]], expected: int | None
) -> None:
    records = [
        {"scene": "door", "method": m, "number": n, "success": n in successes[m]}
        for n in range(4)
        for m in COMPARED_PLANNERS
    ]
    assert choose_shown_trial(records, COMPARED_PLANNERS) == expected
