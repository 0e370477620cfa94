from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.fake_plan import fake_plan, with_metrics

import vkc_pin as vkc
from vkc_pin.benchmarks import initialization
from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.harness.limits import MAX_EVALUATIONS
from vkc_pin.benchmarks.initialization import COMPARED_INITIALIZATIONS, STEPWISE, TARGET
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.validation.report import Report, Violation

BLAME = Violation(
    "closure", "stick", waypoint=3, time=1.0, amount=0.01, unit="m", detail="10 mm off"
)


@pytest.fixture(autouse=True)
def same_sources(monkeypatch: pytest.MonkeyPatch) -> None:
    """The sources may be worked on while the tests run."""
    monkeypatch.setattr(runner, "_sources", lambda: "abc")


def solve(scene: vkc.Scene, spec: Mapping[str, Any]) -> vkc.Plan:
    """A plan that nobody planned, in place of the task: "stationary" always fails, "interpolated" from odd starts."""
    method, number = spec["method"], spec["number"]
    good = method in ("astar", "rrt", "auto", STEPWISE) or (
        method == "interpolated" and number % 2 == 0
    )
    times = ("initialization", "coal", "casadi", "ipopt", "validation")
    metrics = {
        "planning_time": 1.0 + number + 0.25 * COMPARED_INITIALIZATIONS.index(method)
        if method in COMPARED_INITIALIZATIONS
        else 3.0,
        "base_path_length": (5.0 if method == STEPWISE else 4.0) + number,
        "base_path_length_l1": 6.0 + number,
        "arm_path_length": 7.0 + (number if method == STEPWISE else 0.0),
        "clearance": np.inf,
        "closure_error": 1e-4,
        "build_time": 0.5,
        "iterations": 12.0,
        "rounds": 3.0,
        **{f"time_{name}": 0.1 for name in times},
    }
    status = "success" if good else "rejected"
    report = Report() if good else Report((BLAME,))
    return with_metrics(
        fake_plan(scene), metrics, status=status, validation=report, seed=spec["seed"]
    )


def stopping(scene: vkc.Scene, spec: Mapping[str, Any]) -> vkc.Plan:
    """`solve`, stopped by Ctrl-C at start 2, the way the planner notes it."""
    return (
        dataclasses.replace(solve(scene, spec), status="interrupted")
        if spec["number"] == 2
        else solve(scene, spec)
    )


def run(out: Path, **changes: Any) -> dict[str, Any]:
    settings = {
        "starts": 3,
        "repeats": 2,
        "seed": 5,
        "scenes": ["door"],
        "solve": solve,
        "progress": False,
        **changes,
    }
    return initialization.run(out=out, **settings)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bench") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "_sources", lambda: "abc")
        run(folder)
    return folder


@pytest.fixture(scope="module")
def result(out: Path) -> dict[str, Any]:
    return json.loads((out / "results.json").read_text(encoding="utf-8"))


def test_trials(result: dict[str, Any]) -> None:
    trials = result["trials"]
    asked = {(t["method"], t["number"], t["repeat"]) for t in trials}
    assert len(trials) == len(asked) == 3 * 2 * 5 + 3
    assert {(n, r) for m, n, r in asked if m == "astar"} == {
        (n, r) for n in range(3) for r in range(2)
    }
    assert {(n, r) for m, n, r in asked if m == STEPWISE} == {(n, 0) for n in range(3)}
    for t in trials:
        assert (t["seed"], t["perturbation"]) == ((5, 0.0) if t["repeat"] == 0 else (6, 0.05))
        assert (t["scene"], t["clearance"]) == ("door", None)
        assert t["success"] == (t["status"] == "success") == (not t["violations"])
    meta = result["meta"]
    assert (meta["benchmark"], meta["seed"], meta["starts"], meta["repeats"]) == (
        "initialization",
        5,
        3,
        2,
    )
    assert (meta["target"], meta["max_evaluations"]) == (list(TARGET), MAX_EVALUATIONS)
    assert {"pin", "casadi", "coal", "numpy", "vkc-pin"} <= set(meta["versions"])


def test_starts_are_the_same_for_all_methods_and_selections(
    result: dict[str, Any], tmp_path: Path
) -> None:
    starts = {
        number: {tuple(t["start"]) for t in result["trials"] if t["number"] == number}
        for number in range(3)
    }
    assert [len(found) for found in starts.values()] == [1, 1, 1]
    assert len(set.union(*starts.values())) == 3
    fewer = run(tmp_path, starts=2, repeats=1, methods=["astar"])["trials"]
    assert [t["method"] for t in fewer] == [
        "astar",
        "astar",
    ]  # step after step is there to be compared with "auto"
    assert [tuple(t["start"]) for t in fewer] == [*starts[0], *starts[1]]


def test_starts_are_drawn_from_seed_and_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    door = vkc.load_scene("door")
    monkeypatch.setattr(initialization, "load_scene", lambda name: door)

    def bases(seed: int, *scenes: str) -> dict[str, list[list[float]]]:
        specs = initialization.specify(
            starts=2, repeats=1, seed=seed, scenes=scenes, methods=["astar"]
        )
        return {
            scene: [spec["base"] for spec in specs if spec["scene"] == scene] for scene in scenes
        }

    found = bases(5, "init_1", "init_2")
    for number, scene in enumerate(found, start=1):
        rng = np.random.default_rng([5, number])
        assert found[scene] == [door.sample_start(rng).start[:3].tolist() for _ in range(2)]
    assert bases(5, "init_2")["init_2"] == found["init_2"]  # alone, or after another
    assert bases(6, "init_2") != bases(5, "init_2")


def test_the_task(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(
        initialization, "plan", lambda scene, steps, **how: asked.append((scene, steps, how))
    )
    spec = {"seed": 8, "perturbation": 0.05}
    for method in ("stationary", "auto", STEPWISE):
        initialization.plan_trial("scene", {**spec, "method": method})  # type: ignore[arg-type]
    assert all(
        scene == "scene" and how["max_evaluations"] == MAX_EVALUATIONS and how["seed"] == 8
        for scene, _, how in asked
    )
    assert all(how["perturbation"] == 0.05 for _, _, how in asked)
    assert [(how["initialization"], how["joint"]) for _, _, how in asked] == [
        ("stationary", True),
        ("auto", True),
        ("auto", False),
    ]
    for _, (grasp, touch), _ in asked:
        assert (grasp.object, touch.frame, touch.target) == ("stick", "stick.tip", TARGET)


def test_tables_against_numbers_by_hand(out: Path, result: dict[str, Any]) -> None:
    text = (out / "table.md").read_text(encoding="utf-8")
    assert text == initialization.report(result)
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in text.splitlines()
        if line.startswith("| door")
    ]
    assert rows[:6] == [
        # Starts 0, 1, 2, each twice: times 1, 1, 2, 2, 3, 3 and more; 95th percentile at 3.
        ["door", "stationary", "0 of 6", "2.00", "3.00", "–", "–", "0", "rejected (closure) 6"],
        [
            "door",
            "interpolated",
            "4 of 6",
            "2.25",
            "3.25",
            "5.00",
            "7.00",
            "0",
            "rejected (closure) 2",
        ],
        ["door", "astar", "6 of 6", "2.50", "3.50", "5.00", "7.00", "0", "none"],
        ["door", "rrt", "6 of 6", "2.75", "3.75", "5.00", "7.00", "0", "none"],
        ["door", "auto", "6 of 6", "3.00", "4.00", "5.00", "7.00", "0", "none"],
        ["door", STEPWISE, "3 of 3", "3.00", "3.00", "6.00", "8.00", "0", "none"],
    ]
    compared = [[cell for cell in row if cell] for row in rows[6:]]
    assert [row[-3:] for row in compared] == [
        ["5.00 (4.50–5.50)", "6.00 (5.50–6.50)", "3 of 3"],
        ["7.00 (6.50–7.50)", "7.00 (6.50–7.50)", "0 of 3"],
        ["7.00 (7.00–7.00)", "8.00 (7.50–8.50)", "2 of 3"],
    ]
    last = text.splitlines()[-1]
    for part in ("Measured on", "casadi", "Python", "33 trials, 1 at a time"):
        assert part in last


def test_chart_and_csv(out: Path, result: dict[str, Any]) -> None:
    from matplotlib.image import imread

    image = imread(out / "success.png")[..., :3]
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 50
    assert 0.02 < float((np.ptp(image, axis=2) > 0.2).mean()) < 0.6  # coloured bars
    with (out / "results.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["key"], float(row["base_path_length"])) for row in rows] == [
        (trial["key"], trial["base_path_length"]) for trial in result["trials"]
    ]


def test_going_on_after_ctrl_c_gives_the_same_table(
    tmp_path: Path, result: dict[str, Any], out: Path
) -> None:
    with pytest.raises(KeyboardInterrupt, match="22 of 33 trials are done"):
        run(tmp_path, solve=stopping)
    assert not (tmp_path / "table.md").exists()
    assert run(tmp_path)["trials"] == result["trials"]
    tables = [
        (folder / "table.md").read_text(encoding="utf-8").splitlines()[:-1]
        for folder in (tmp_path, out)
    ]
    assert tables[0] == tables[1]  # the last line says how long it took


def test_jobs_make_no_difference(tmp_path: Path, result: dict[str, Any]) -> None:
    assert run(tmp_path, jobs=2)["trials"] == result["trials"]


def test_other_settings_are_refused(out: Path) -> None:
    for changes in ({"starts": 4}, {"repeats": 1}, {"seed": 6}, {"methods": ["auto"]}):
        with pytest.raises(InputError, match=rf"{next(iter(changes))}.*use another folder"):
            run(out, **changes)


def test_names_that_do_not_exist(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'astar'"):
        run(tmp_path, methods=["astra"])
    with pytest.raises(UnknownNameError, match="init_1"):
        run(tmp_path, scenes=["door"], solve=initialization.plan_trial)  # there is no stick
    for nothing in ("scenes", "methods"):
        with pytest.raises(InputError, match=f"{nothing}: there is nothing to run"):
            run(tmp_path, **{nothing: []})
    assert not list(tmp_path.iterdir())
