"""The benchmark of chores, with a planner that pretends, and one real trial from the command line."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.fake_plan import with_metrics

import vkc_pin as vkc
from vkc_pin.benchmarks import chores
from vkc_pin.benchmarks.harness import step_by_step as stepwise
from vkc_pin.cli import main
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.world.models.shapes import compute_clearance
from vkc_pin.world.scene.clearance_exemptions import find_close_pairs
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.task.actions import compile_each_step, group_into_actions


@pytest.mark.parametrize(
    ("name", "number", "actions"), [("home", 18, 10), ("fetch", 10, 6), ("cluttered", 18, 10)]
)
def test_chores_have_the_papers_steps(name: str, number: int, actions: int) -> None:
    chore = chores.CHORES[name]
    scene, listed = chore.scene(), chore.planned()
    assert len(listed) == number
    assert len(group_into_actions(listed)) == actions
    compile_each_step(scene, listed, chore.options)  # none of them is impossible at its place


def test_the_cluttered_home_is_the_home_and_more() -> None:
    home, full = vkc.load_scene("household"), chores.cluttered_home()
    assert full.document["obstacles"][: len(home.document["obstacles"])] == list(
        home.document["obstacles"]
    )
    shapes = [len(placed.object.collision.geometryObjects) for placed in full.objects.values()]
    assert len(full.obstacles) + sum(shapes) > 500


def gap(scene: vkc.Scene, first: str, second: str) -> float:
    """Return how far two links stand apart [m]."""
    (pair,) = [
        pair
        for pair in find_close_pairs(scene, 0.02)
        if {pair.first, pair.second} == {first, second}
    ]
    return pair.distance


def test_the_cluttered_home_is_as_tight_as_real_ones() -> None:
    """Leaves stand in and at their walls, and handles next to other things, at the start or where the chore leaves them."""
    full = chores.cluttered_home()
    opened = full.with_state("door", {"hinge": 1.52})
    assert gap(full, "door.panel", "casing_above") == pytest.approx(-0.05, abs=1e-4)
    assert gap(opened, "door.panel", "casing_above") == pytest.approx(-0.05, abs=1e-4)
    assert gap(full, "door.panel", "casing_beside") == pytest.approx(-0.02, abs=1e-4)
    assert gap(full, "refrigerator.door", "panel_east") == pytest.approx(0.0, abs=1e-4)
    assert gap(full, "refrigerator.door", "panel_west") == pytest.approx(0.009, abs=1e-4)
    assert gap(full, "door.lever", "bag") == pytest.approx(0.01, abs=1e-4)
    assert gap(opened, "door.lever", "wardrobe") == pytest.approx(0.01, abs=5e-4)
    assert chores.CHORES["cluttered"].options.dist_safe == 0.005


@pytest.mark.parametrize(("carried", "other"), [("cold_cup", "bottle"), ("broom", "mop")])
def test_what_is_carried_has_a_neighbour(carried: str, other: str) -> None:
    full = chores.cluttered_home()
    shapes = [
        (shape.geometry, shape.placement) for shape in make_world_shapes(full.objects[carried])
    ]
    (index,) = [i for i, label in enumerate(full.obstacle_labels) if label == other]
    assert compute_clearance(
        shapes, [(full.obstacles[index].geometry, full.obstacles[index].placement)]
    ) == pytest.approx(0.01, abs=1e-4)


def test_one_step_less_is_noticed() -> None:
    """Without putting the broom back the hand is not free for the litter."""
    scene = vkc.load_scene("household")
    steps = chores.home(scene)
    del steps[15]
    with pytest.raises(InputError, match=r"steps\[15\]"):
        compile_each_step(scene, steps, vkc.Options())


def stay(scene: vkc.Scene, spec: Mapping[str, Any]) -> vkc.Plan:
    """Return a plan whose success hangs on the number of the trial."""
    plan = vkc.plan(scene, [vkc.GoTo(*scene.start[:2])], seed=spec["seed"])
    status = "success" if spec["number"] else "not converged"
    return with_metrics(plan, {"planning_time": 1.0 + spec["number"]}, status=status)


def test_every_trial_is_on_record(tmp_path: Path) -> None:
    result = chores.run(
        trials=3, seed=4, out=tmp_path, chores=("fetch",), progress=False, solve=stay
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


def test_what_hangs_on_seeds_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two seeds one call fails with the first; step by step, the second step fails."""

    def some(scene: vkc.Scene, spec: Mapping[str, Any]) -> vkc.Plan:
        return stay(scene, {**spec, "number": spec["seed"] - 4})

    def two(
        scene: vkc.Scene, steps: list[vkc.Step], *, options: vkc.Options, seed: int
    ) -> list[vkc.Plan]:
        plans = [stay(scene, {"seed": seed, "number": number}) for number in (1, 0)]
        return [with_metrics(one, {**one.metrics, "arm_path_length": float(seed)}) for one in plans]

    monkeypatch.setattr(stepwise, "step_by_step", two)
    settings = {
        "trials": 1,
        "seed": 4,
        "seeds": 2,
        "step_by_step": True,
        "chores": ("fetch",),
        "progress": False,
    }
    result = chores.run(out=tmp_path, solve=some, **settings)
    assert [(one["seed"], one["method"], one["success"]) for one in result["trials"]] == [
        (4, "VKC", False),
        (4, "step by step", False),
        (5, "VKC", True),
        (5, "step by step", False),
    ]
    assert [one["arm_path_length"] for one in result["trials"][1::2]] == [8.0, 10.0]
    assert [one["steps_done"] for one in result["trials"]] == [None, 1, 10, 1]
    table = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert "| fetch | 0 | in one call | 1 of 2 | all |" in table
    assert "| fetch | 0 | step by step | 0 of 2 | 1, 1 |" in table
    assert "nan" not in table


def test_spread_is_of_the_least_and_of_the_middle() -> None:
    assert chores._apart(50.0, 70.0) == ["50.0–70.0", "40", "17"]
    assert chores._apart(0.0, 70.0) == ["0.0–70.0", "–", "–"]


def test_unknown_chores_are_named(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'fetch'"):
        chores.run(trials=1, seed=0, out=tmp_path, chores=("fetsh",))
    with pytest.raises(InputError, match="chores: there is nothing to run"):
        chores.run(trials=1, seed=0, out=tmp_path, chores=())


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("name", "joints", "things"),
    [
        (
            "home",
            {"refrigerator": 0.0, "door": 0.0},
            {"cold_cup": chores.DESK, "litter": chores.BIN},
        ),
        ("fetch", {"cabinet": 0.0}, {"ball": chores.SHELF}),
    ],
)
def test_every_chore_is_really_planned(
    name: str, joints: Mapping[str, float], things: Mapping[str, tuple[float, float, float]]
) -> None:
    """As the experiment asks for it, and looked at anew from what the plan has: steps, motion, and the scene at its end."""
    scene, steps, options = (
        chores.CHORES[name].scene(),
        chores.CHORES[name].planned(),
        chores.CHORES[name].options,
    )
    plan = vkc.plan(scene, steps, options=options, seed=7, window=2)
    assert plan.success, plan.summary()
    assert vkc.validate(scene, plan.steps, plan.trajectory, options).ok
    last = plan.end_scene()
    for owner, value in joints.items():
        index = last.objects[owner].object.coordinates.index("hinge")
        assert last.objects[owner].state[index] == pytest.approx(value, abs=1e-3)
    for owner, place in things.items():
        np.testing.assert_allclose(last.objects[owner].placement.translation, place, atol=2e-3)


@pytest.mark.long
def test_ten_steps_in_one_call(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        main(
            [
                "bench",
                "chores",
                "--trials",
                "1",
                "--chores",
                "fetch",
                "--out",
                str(tmp_path / "out"),
                "--quiet",
            ]
        )
        == 0
    )
    (trial,) = json.loads((tmp_path / "out" / "results.json").read_text(encoding="utf-8"))["trials"]
    assert trial["success"], trial["violations"]
    assert trial["planning_time"] < trial["wall_time"]
    assert trial["base_path_length"] > 10.0  # from table to table to cabinet
    assert "| fetch | 10 | 1 of 1 |" in capsys.readouterr().out
