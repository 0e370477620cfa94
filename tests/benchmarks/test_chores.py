"""Tests chores of many steps, with a fake planner that only drives."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.fake_plan import replace_metrics

import vkc_pin as vkc
from vkc_pin.benchmarks import chores
from vkc_pin.benchmarks.harness.record import describe_environment
from vkc_pin.errors import InputError
from vkc_pin.world.scene.clearance_exemptions import find_close_pairs
from vkc_pin.world.task.actions import compile_each_step, group_into_actions


@pytest.mark.parametrize(
    ("name", "number", "actions"), [("home", 18, 10), ("fetch", 10, 6), ("cluttered", 18, 10)]
)
def test_chores_have_the_papers_steps(name: str, number: int, actions: int) -> None:
    chore = chores.CHORES[name]
    scene, steps = chore.scene(), chore.list_steps()
    assert len(steps) == number
    assert len(group_into_actions(steps)) == actions
    compile_each_step(scene, steps, chore.options)


def test_cluttered_home_contains_the_home() -> None:
    home, cluttered = vkc.load_scene("household"), chores.make_cluttered_home()
    assert cluttered.document["obstacles"][: len(home.document["obstacles"])] == list(
        home.document["obstacles"]
    )
    shapes = [len(placed.object.collision.geometryObjects) for placed in cluttered.objects.values()]
    assert len(cluttered.obstacles) + sum(shapes) > 500


def compute_distance(scene: vkc.Scene, first: str, second: str) -> float:
    """Return the distance between two links [m]."""
    (pair,) = [
        pair
        for pair in find_close_pairs(scene, 0.02)
        if {pair.first, pair.second} == {first, second}
    ]
    return pair.distance


def test_cluttered_home_has_overlaps_and_small_gaps() -> None:
    """Door leaves overlap and touch walls; handles are near obstacles."""
    cluttered = chores.make_cluttered_home()
    opened = cluttered.with_state("door", {"hinge": 1.52})
    assert compute_distance(cluttered, "door.panel", "casing_above") == pytest.approx(
        -0.05, abs=1e-4
    )
    assert compute_distance(opened, "door.panel", "casing_above") == pytest.approx(-0.05, abs=1e-4)
    assert compute_distance(cluttered, "door.panel", "casing_beside") == pytest.approx(
        -0.02, abs=1e-4
    )
    assert compute_distance(cluttered, "refrigerator.door", "panel_east") == pytest.approx(
        0.0, abs=1e-4
    )
    assert compute_distance(cluttered, "refrigerator.door", "panel_west") == pytest.approx(
        0.009, abs=1e-4
    )
    assert compute_distance(cluttered, "door.lever", "bag") == pytest.approx(0.01, abs=1e-4)
    assert compute_distance(opened, "door.lever", "wardrobe") == pytest.approx(0.01, abs=5e-4)
    assert chores.CHORES["cluttered"].options.dist_safe == 0.005


def test_steps_depend_on_each_other() -> None:
    """The hand must put the broom back before it grasps the litter."""
    scene = vkc.load_scene("household")
    steps = chores.home(scene)
    del steps[15]
    with pytest.raises(InputError, match=r"steps\[15\]"):
        compile_each_step(scene, steps, vkc.Options())


def plan_to_stay(scene: vkc.Scene, spec: Mapping[str, Any]) -> vkc.Plan:
    """Return a plan that succeeds unless the number of the trial is 0."""
    plan = vkc.plan(scene, [vkc.GoTo(*scene.start[:2])], seed=spec["seed"])
    status = "success" if spec["number"] else "not converged"
    return replace_metrics(plan, {"planning_time": 1.0 + spec["number"]}, status=status)


def test_trials_are_recorded(tmp_path: Path) -> None:
    result = chores.run(
        trials=3, seed=4, out=tmp_path, chores=("fetch",), progress=False, solve=plan_to_stay
    )
    assert [trial["number"] for trial in result["trials"]] == [0, 1, 2]
    assert [trial["success"] for trial in result["trials"]] == [False, True, True]
    assert len(result["meta"]["steps"]["fetch"]) == 10
    starts = np.array([trial["start"] for trial in result["trials"]])
    np.testing.assert_allclose(starts[0], vkc.load_scene("fetch").start, atol=1e-9)
    assert len(np.unique(starts[:, :2], axis=0)) == 3
    table = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert "| fetch | 10 | 2 of 3 |" in table
    assert "not converged 1" in table
    assert table.count("| fetch | ") == 4
    assert json.loads((tmp_path / "results.json").read_text(encoding="utf-8")) == result


def test_table_of_seeds_counts_successes_and_steps() -> None:
    def make_record(seed: int, method: str, done: int | None) -> dict[str, Any]:
        fields = {"scene": "fetch", "number": 0, "method": method, "seed": seed, "steps_done": done}
        success = done == 10
        status = "success" if success else "not converged"
        return {**fields, "success": success, "status": status, "arm_path_length": 3.0 + seed}

    trials = [make_record(4, "VKC", None), make_record(4, "step by step", 1)]
    trials += [
        make_record(5, "VKC", 10),
        make_record(5, "step by step", 10),
        make_record(6, "step by step", 10),
    ]
    meta = {"chores": ["fetch"], "steps": {"fetch": 10 * ["x"]}, "starts": 1, "seed": 4}
    meta |= {"seeds": 3, "window": 2, "methods": ["VKC", "step by step"]}
    text = chores.format_results({"meta": {**describe_environment(), **meta}, "trials": trials})
    assert "| fetch | 0 | in one call | 1 of 2 | all |" in text
    assert "| fetch | 0 | step by step | 2 of 3 | 1, all, all |" in text
    assert "| 8.0–9.0 | 12 | 6 |" in text, "(9 - 8) / 8 and (9 - 8) / (9 + 8)"
    assert "nan" not in text
