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
from vkc_pin import InputError
from vkc_pin.experiments import chores
from vkc_pin.experiments.harness.record import describe_environment
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


@pytest.mark.parametrize(
    ("first", "second", "distance"),
    [
        ("door.panel", "casing_above", -0.05),
        ("door.panel", "casing_beside", -0.02),
        ("refrigerator.door", "panel_east", 0.0),
        ("refrigerator.door", "panel_west", 0.009),
        ("door.lever", "bag", 0.01),
        ("open door.lever", "wardrobe", 0.01),
    ],
)
def test_cluttered_home_has_overlaps_and_small_gaps(
    first: str, second: str, distance: float
) -> None:
    """Door leaves overlap and touch walls; handles are near obstacles."""
    scene, link = chores.make_cluttered_home(), first.removeprefix("open ")
    if link != first:
        scene = scene.with_state("door", {"hinge": 1.52})
    found = {frozenset((one.first, one.second)): one for one in find_close_pairs(scene, 0.02)}
    assert found[frozenset((link, second))].distance == pytest.approx(distance, abs=5e-4)
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
        success = done == 10
        fields = {"scene": "fetch", "number": 0, "method": method, "seed": seed, "steps_done": done}
        status = "success" if success else "not converged"
        return {**fields, "success": success, "status": status, "arm_path_length": 3.0 + seed}

    trials = [make_record(4, "VKC", None), make_record(5, "VKC", 10)]
    trials += [make_record(seed, "step by step", done) for seed, done in ((4, 1), (5, 10), (6, 10))]
    meta = {"chores": ["fetch"], "steps": {"fetch": 10 * ["x"]}, "starts": 1, "seed": 4}
    meta |= {"seeds": 3, "window": 2, "methods": ["VKC", "step by step"]}
    text = chores.format_results({"meta": {**describe_environment(), **meta}, "trials": trials})
    assert "| fetch | 0 | in one call | 1 of 2 | all |" in text
    assert "| fetch | 0 | step by step | 2 of 3 | 1, all, all |" in text
    assert "| 8.0–9.0 | 12 | 6 |" in text, "(9 - 8) / 8 and (9 - 8) / (9 + 8)"
    assert "nan" not in text
