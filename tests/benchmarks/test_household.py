"""The third experiment: its tasks, where the cup stands, charts and tables; nothing is planned here."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest
from helpers.fake_plan import fake_plan, with_metrics
from helpers.markdown import cells
from helpers.small_problems import program_of

import vkc_pin as vkc
from vkc_pin.benchmarks import comparison, household
from vkc_pin.benchmarks.comparison import placed
from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.harness.limits import LIMITS
from vkc_pin.benchmarks.household import (
    COMPARED_PLANNERS,
    COMPARISON,
    PAPER,
    TABLE_TOP,
    TASKS,
    on_the_coffee_table,
    papers_home,
)
from vkc_pin.cli import main
from vkc_pin.validation.report import Report, Violation
from vkc_pin.world.models.shapes import compute_clearance, list_placed_shapes
from vkc_pin.world.scene.placed_object import make_world_shapes

GOOD = {("cup", "B1"): {0}, ("cup", "B2"): {0, 1}, ("door", "B2"): {1}}
"""(task, method) → the starts from which `solve` has it succeed; VKC always does."""
BLAME = Violation(
    "closure",
    "door.handle",
    waypoint=9,
    time=4.0,
    amount=0.09,
    unit="m",
    detail="the grasp drifts by 90 mm",
)


@pytest.fixture(autouse=True)
def same_sources(monkeypatch: pytest.MonkeyPatch) -> None:
    """The sources may be worked on while the tests run."""
    monkeypatch.setattr(runner, "_sources", lambda: "abc")


def solve(scene: vkc.Scene, spec: Mapping[str, Any]) -> vkc.Plan:
    """A plan that nobody planned, in place of the task."""
    task, method, number = spec["scene"], spec["method"], spec["number"]
    good, k = (
        method == "VKC" or number in GOOD.get((task, method), ()),
        COMPARED_PLANNERS.index(method),
    )
    plan = fake_plan()
    metrics = {
        **plan.trajectory.metrics(),
        "planning_time": 2.0 + number - 0.5 * k,
        "build_time": 0.5,
        "base_path_length": 5.0 + number - k,
        "arm_path_length": 9.0 + 2.0 * number,
        "clearance": 0.02,
        "closure_error": 1e-4,
        "iterations": 12.0,
        "rounds": 3.0,
    }
    validation = Report() if good else Report((BLAME,), -0.03)
    status = "success" if good else "no inverse kinematics"
    return with_metrics(
        plan,
        metrics,
        scene=scene,
        status=status,
        validation=validation,
        seed=spec["seed"],
        steps=TASKS[task].steps,
    )


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bench") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "_sources", lambda: "abc")
        patch.setattr(
            comparison, "motions_chart", lambda plans, path, title: path.write_bytes(title.encode())
        )
        household.run(
            trials=2, seed=3, tasks=["door", "cup"], out=folder, progress=False, solve=solve
        )
    return folder


@pytest.fixture(scope="module")
def result(out: Path) -> dict[str, Any]:
    return json.loads((out / "results.json").read_text(encoding="utf-8"))


# --- what is run
# -------------------------------------------------------------------------------------------------------


def test_the_tasks_are_the_papers() -> None:
    assert {name: task.steps for name, task in TASKS.items()} == {
        "cup": (vkc.Place("cup", (-0.6, -1.6, 0.751)),),
        "door": (
            vkc.Actuate("door", {"hinge": 1.52}, attachment="handle_free"),
            vkc.GoTo(1.6, 2.5),
        ),
        "drawer": (vkc.Actuate("drawer", {"slide": 0.22}),),
        "dishwasher": (vkc.Actuate("dishwasher", {"rack": 0.5}),),
        "refrigerator": (vkc.Actuate("refrigerator", {"hinge": 1.57}),),
        "cabinet": (vkc.Actuate("cabinet", {"hinge": 0.4}),),
    }
    assert {task.scene for task in TASKS.values()} == {"household"}
    scene = vkc.load_scene("household")
    for task in TASKS.values():  # everything that they name is there
        assert program_of(scene, task.steps).segments > 0


def test_every_method_is_asked_for_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[Any, ...]] = []
    for name in ("plan", "plan_separately"):
        monkeypatch.setattr(
            comparison, name, lambda scene, steps, **how: asked.append((scene, steps, how))
        )
    for task in TASKS:
        for method in COMPARED_PLANNERS:
            household.plan_trial("scene", {"scene": task, "method": method, "seed": 8})  # type: ignore[arg-type]
    common = {**LIMITS, "seed": 8}
    hows = ({**common, "method": "B1", "finer": 2}, {**common, "method": "B2", "finer": 2}, common)
    assert asked == [("scene", task.steps, how) for task in TASKS.values() for how in hows]


def test_the_variant_has_the_numbers_of_the_papers_code() -> None:
    """A cup at (-0.6, -1.6, 1.11) that stands on something, a rack out by 0.8 by a hand at its side; all else is the same."""
    ours, theirs = vkc.load_scene("household"), papers_home()
    differing = {name: task.steps for name, task in PAPER.tasks.items() if task != TASKS[name]}
    assert differing == {
        "cup": (vkc.Place("cup", (-0.6, -1.6, 1.11)),),
        "dishwasher": (vkc.Actuate("dishwasher", {"rack": 0.8}, attachment="other_side"),),
    }
    upper = {
        name: dict(zip(o.object.coordinates.names, o.object.upper, strict=True))
        for name, o in theirs.objects.items()
    }
    was = {
        name: dict(zip(o.object.coordinates.names, o.object.upper, strict=True))
        for name, o in ours.objects.items()
    }
    assert upper == {**was, "dishwasher": {**was["dishwasher"], "rack": 0.8}}
    there = theirs.with_placement("cup", pin.SE3(np.eye(3), np.array([-0.6, -1.6, 1.11])))
    cup = list_placed_shapes(make_world_shapes(there.objects["cup"]))
    assert compute_clearance(cup, list_placed_shapes(there.obstacles)) == pytest.approx(
        1e-3, abs=1e-6
    )
    labels = [
        [label for label in scene.obstacle_labels if "dining_table" not in label]
        for scene in (ours, theirs)
    ]
    assert labels[0] == labels[1]
    assert vkc.Scene.from_document(theirs.document, theirs.folder).document == theirs.document


def test_the_variant_begins_where_the_experiment_does() -> None:
    plain, paper = (
        which.specify(trials=2, seed=3, tasks=list(TASKS), methods=["VKC"], max_evaluations=7)
        for which in (COMPARISON, PAPER)
    )
    assert plain == paper


def test_the_variant_is_run_and_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its own two tasks unless told otherwise, in its own scene."""
    seen: list[Any] = []

    def look(scene: vkc.Scene, spec: Mapping[str, Any]) -> vkc.Plan:
        seen.append((spec["scene"], scene.name, float(scene.objects["dishwasher"].object.upper[1])))
        return solve(scene, spec)

    monkeypatch.setattr(
        comparison, "motions_chart", lambda plans, path, title: path.write_bytes(title.encode())
    )
    how: dict[str, Any] = {
        "trials": 1,
        "seed": 3,
        "methods": ["VKC"],
        "progress": False,
        "solve": look,
    }
    result = household.run(variant="paper", out=tmp_path / "paper", **how)
    assert seen
    assert {(task, rack) for task, _, rack in seen} == {("cup", 0.8), ("dishwasher", 0.8)}
    assert all("paper" in name for _, name, _ in seen)
    assert result["meta"]["goals"] == {
        "cup": {"cup": [-0.6, -1.6, 1.11]},
        "dishwasher": {"dishwasher.rack": 0.8},
    }
    title = "# Two tasks in a home, with the numbers of the paper's code\n"
    assert household.report(result).startswith(title)
    assert (tmp_path / "paper" / "table.md").read_text(encoding="utf-8").startswith(title)
    usual = household.run(out=tmp_path / "usual", tasks=["cup"], **how)
    assert household.report(usual).startswith("# Six tasks in a home\n")
    seen.clear()
    household.run(
        variant="paper", out=tmp_path / "door", tasks=["door"], **how
    )  # which has no other numbers there
    assert set(seen) == {("door", "household", 0.55)}


@pytest.mark.long
@pytest.mark.parametrize("name", ["cup", "dishwasher"])
def test_the_variant_is_really_planned(name: str) -> None:
    (spec,) = PAPER.specify(trials=1, seed=7, tasks=[name], methods=["VKC"])
    scene = placed(papers_home(), spec).with_start(base=spec["base"])
    plan = PAPER.plan_trial(scene, spec)
    assert plan.success, plan.summary()
    assert vkc.validate(scene, PAPER.tasks[name].steps, plan.trajectory, plan.options).ok


@pytest.mark.long
@pytest.mark.parametrize("method", COMPARED_PLANNERS)
@pytest.mark.parametrize("name", TASKS)
def test_every_task_is_really_planned(name: str, method: str) -> None:
    """From a start of its own; the planner must succeed, and a baseline that does is as good."""
    task = TASKS[name]
    (spec,) = COMPARISON.specify(trials=1, seed=7, tasks=[name], methods=[method])
    scene = placed(vkc.load_scene(task.scene), spec).with_start(base=spec["base"])
    plan = household.plan_trial(scene, spec)
    if method == "VKC":
        assert plan.success, plan.summary()
    report = vkc.validate(scene, task.steps, plan.trajectory, plan.options)
    assert report.ok == plan.success
    assert report.contradictions(plan.report) == []


def test_the_cup_stands_wholly_on_the_coffee_table() -> None:
    scene, rng = vkc.load_scene("household"), np.random.default_rng(0)
    shapes = list(scene.obstacles)
    table = [
        shape
        for shape, label in zip(shapes, scene.obstacle_labels, strict=True)
        if label == "coffee_table"
    ]
    plate = max(table, key=lambda shape: shape.placement.translation[2])
    assert isinstance(plate.geometry, coal.Box)
    np.testing.assert_allclose(
        np.transpose(TABLE_TOP)[0], (plate.placement.translation - plate.geometry.halfSide)[:2]
    )
    np.testing.assert_allclose(
        np.transpose(TABLE_TOP)[1], (plate.placement.translation + plate.geometry.halfSide)[:2]
    )
    others = [shape for shape in shapes if shape is not plate]
    poses = np.array([on_the_coffee_table(scene, rng)["cup"] for _ in range(300)])
    for pose in poses[:40]:
        there = scene.with_placement("cup", pin.SE3(pin.rpy.rpyToMatrix(*pose[3:]), pose[:3]))
        cup = list_placed_shapes(make_world_shapes(there.objects["cup"]))
        off = np.abs(pose[:2] - plate.placement.translation[:2])
        assert np.all(off + 0.035 < plate.geometry.halfSide[:2]), "all of its foot"
        assert compute_clearance(cup, list_placed_shapes([plate])) == pytest.approx(
            1e-3, abs=1e-6
        ), "it stands on the plate"
        assert compute_clearance(cup, list_placed_shapes(others), reach=0.1) > 0.02, (
            "and in nothing"
        )
    assert np.ptp(poses[:, 0]) > 0.35
    assert np.ptp(poses[:, 1]) > 0.85
    assert np.ptp(poses[:, 5]) > 6.0
    assert not np.ptp(poses[:, 2:5], axis=0).any()


def test_starts_and_places_are_drawn_from_seed_and_task_and_the_same_for_all_methods(
    result: dict[str, Any],
) -> None:
    specs = COMPARISON.specify(trials=2, seed=3, tasks=list(TASKS), methods=["B1", "VKC"])
    assert [(s["scene"], s["method"], s["number"], s["seed"]) for s in specs] == [
        (task, method, number, 3 + number)
        for task in TASKS
        for method in ("B1", "VKC")
        for number in (0, 1)
    ]
    rng, scene = np.random.default_rng([3, 0]), vkc.load_scene("household")
    for number in (0, 1):
        pose = on_the_coffee_table(scene, rng)
        base = placed(scene, {"placed": pose}).sample_start(rng).start[:3].tolist()
        mine = [s for s in specs if (s["scene"], s["number"]) == ("cup", number)]
        assert all(s["placed"] == pose and s["base"] == base for s in mine)
        recorded = [t for t in result["trials"] if (t["scene"], t["number"]) == ("cup", number)]
        assert [t["placed"] for t in recorded] == [pose] * 3
        np.testing.assert_allclose([t["start"][:3] for t in recorded], [base] * 3, atol=1e-8)
    assert all("placed" not in s for s in specs if s["scene"] != "cup")
    (alone,) = COMPARISON.specify(trials=1, seed=3, tasks=["cabinet"], methods=["B2"])
    assert alone["base"] == next(s["base"] for s in specs if s["scene"] == "cabinet")


def test_a_trial_is_planned_with_the_cup_where_it_was_drawn(tmp_path: Path) -> None:
    seen: list[tuple[Any, ...]] = []

    def look(scene: vkc.Scene, spec: Mapping[str, Any]) -> vkc.Plan:
        seen.append((scene.objects["cup"].placement, scene.start[:3].tolist(), spec))
        return solve(scene, {**spec, "method": "VKC"})

    household.run(
        trials=2, seed=0, tasks=["cup"], methods=["B1"], out=tmp_path, progress=False, solve=look
    )
    assert len(seen) >= 2
    for cup, base, spec in seen:
        np.testing.assert_allclose(cup.translation, spec["placed"]["cup"][:3])
        assert pin.rpy.matrixToRpy(cup.rotation)[2] == pytest.approx(spec["placed"]["cup"][5])
        assert base == spec["base"]


def test_records(result: dict[str, Any]) -> None:
    trials = result["trials"]
    assert [t["key"] for t in trials] == [
        f"{task}/{n:04d}/{m}" for task in ("cup", "door") for n in (0, 1) for m in COMPARED_PLANNERS
    ]
    for t in trials:
        assert t["success"] == (
            t["method"] == "VKC" or t["number"] in GOOD.get((t["scene"], t["method"]), ())
        )
        assert t["seed"] == 3 + t["number"]
    meta = result["meta"]
    assert (meta["benchmark"], meta["seed"], meta["starts"], meta["tasks"]) == (
        "household",
        3,
        2,
        ["cup", "door"],
    )
    assert meta["goals"] == {
        "cup": {"cup": [-0.6, -1.6, 0.751]},
        "door": {"door.hinge": 1.52, "base": [1.6, 2.5]},
    }


# --- what is shown
# -----------------------------------------------------------------------------------------------------


def test_tables_against_numbers_by_hand(out: Path) -> None:
    text = (out / "table.md").read_text(encoding="utf-8")
    assert text.startswith(
        "# Six tasks in a home\n\n`cup`: carry a cup to the dining table and `door`: push a narrow door open"
    )
    sections = {
        part.split("\n", 1)[0]: part.split("\n", 1)[1].strip() for part in text.split("## ")[1:]
    }

    def rows(title: str) -> list[list[str]]:
        return cells(
            "\n".join(
                line for line in sections[title].splitlines() if line.startswith("|")
            ).replace("\\|", "/")
        )[1:]

    cause = "no inverse kinematics (closure)"
    assert rows("Success") == [
        ["cup", "B1", "1 of 2", "50", "9–91", "0", f"{cause} 1"],
        ["cup", "B2", "2 of 2", "100", "34–100", "0", "none"],
        ["cup", "VKC", "2 of 2", "100", "34–100", "0", "none"],
        ["door", "B1", "0 of 2", "0", "0–66", "0", f"{cause} 2"],
        ["door", "B2", "1 of 2", "50", "9–91", "0", f"{cause} 1"],
        ["door", "VKC", "2 of 2", "100", "34–100", "0", "none"],
        ["all", "B1", "1 of 4", "25", "5–70", "0", f"{cause} 3"],
        ["all", "B2", "3 of 4", "75", "30–95", "0", f"{cause} 1"],
        ["all", "VKC", "4 of 4", "100", "51–100", "0", "none"],
    ]
    shared = rows("Efforts, peaks and durations where all methods succeed")
    assert shared[0] == ["cup", "base [m]", "5.00 ± –; 5.00", "4.00 ± –; 4.00", "3.00 ± –; 3.00"]
    assert shared[6] == ["door", "base [m]", "–", "–", "–"]
    own = rows("Efforts, peaks and durations over each method's own successes")
    assert own[1] == ["cup", "base [m]", "5.00 ± –; 5.00", "4.50 ± 0.71; 4.50", "3.50 ± 0.71; 3.50"]
    assert own[10] == ["door", "arm [rad]", "–", "11.00 ± –; 11.00", "10.00 ± 1.41; 10.00"]
    pictures = (
        "success",
        "base_path_length",
        "arm_path_length",
        "planning_time",
        "cup_joints",
        "door_joints",
    )
    assert [f"]({name}.png)" in text for name in pictures] == [True] * 6
    for name in pictures[:4]:
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    assert (out / "cup_joints.png").read_text(
        encoding="utf-8"
    ) == "Carry a cup to the dining table, trial 0"
    assert (out / "door_joints.png").read_text(encoding="utf-8").endswith("trial 1")


def test_charts_have_all_tasks_and_methods(
    tmp_path: Path, result: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: dict[str, tuple[Any, ...]] = {}

    def chart(
        records: Any, path: Path, scenes: Mapping[str, str], methods: Any, **how: Any
    ) -> None:
        drawn[path.name] = (len(records), list(scenes), methods, how)

    monkeypatch.setattr(household, "success_chart", chart)
    monkeypatch.setattr(household, "means_chart", chart)
    pictures = COMPARISON.draw(
        result["trials"], tmp_path, {"cup": "carry", "door": "push"}, COMPARED_PLANNERS
    )
    assert [picture.split("](")[1] for picture in pictures] == [f"{name})" for name in drawn]
    assert all(case[:3] == (12, ["cup", "door"], COMPARED_PLANNERS) for case in drawn.values())
    assert {name: case[3].get("shared") for name, case in drawn.items()} == {
        "success.png": None,
        "base_path_length.png": True,
        "arm_path_length.png": True,
        "planning_time.png": False,
    }


# --- the command
# -------------------------------------------------------------------------------------------------------


def test_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: dict[str, Any] = {}
    real = household.run

    def fake(**given: Any) -> dict[str, Any]:
        asked.update(given)
        return real(**given, solve=solve)

    monkeypatch.setattr(household, "run", fake)
    monkeypatch.setattr(comparison, "motions_chart", lambda plans, path, title: None)
    command = [
        "bench",
        "household",
        "--trials",
        "1",
        "--seed",
        "4",
        "--jobs",
        "1",
        "--out",
        str(tmp_path),
        "--quiet",
    ]
    command += ["--tasks", "drawer", "--methods", "VKC", "B1", "--save-failures"]
    assert main(command) == 0
    assert capsys.readouterr().out.startswith((tmp_path / "table.md").read_text(encoding="utf-8"))
    assert asked == {
        **{
            "trials": 1,
            "seed": 4,
            "jobs": 1,
            "out": str(tmp_path),
            "tasks": ["drawer"],
            "methods": ["VKC", "B1"],
        },
        **{"save_failures": True, "progress": False},
    }
    assert [path.name for path in (tmp_path / "failures").iterdir()] == ["drawer_0000_B1.npz"]
    assert main([*command, "--trials", "2"]) == 2
    assert "use another folder" in capsys.readouterr().err


def test_twenty_trials_unless_told_otherwise() -> None:
    from vkc_pin.cli.commands import make_parser

    given = make_parser().parse_args(["bench", "household", "--out", "x"])
    assert (given.trials, given.tasks, given.methods) == (20, None, None)
    assert make_parser().parse_args(["bench", "baselines", "--out", "x"]).trials == 50


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--tasks", "fridge"], "there is no task 'fridge'"),
        (["--methods", "B3"], "'B3'"),
        (["--variant", "papers"], "there is no variant 'papers'"),
    ],
)
def test_misuse(
    more: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", "household", "--out", str(tmp_path / "out"), *more]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
