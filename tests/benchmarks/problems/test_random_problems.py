"""Tests random problems: their sampling, saved plans, and verdicts of the oracle."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.experiments import run_benchmark
from oracle.agreement import judge_all, record_violations, write_verdicts
from oracle.plan import read_plan

from tests.benchmarks.problems import random_problems
from tests.benchmarks.problems.random_problems import sample_problem
from vkc_pin import InputError, Plan
from vkc_pin.procedural.tasks import random_task
from vkc_pin.world.files.resources import list_resources
from vkc_pin.world.task.steps import step_to_dict


@pytest.mark.parametrize("number", [1, 6])
def test_problems_are_determined_by_seed_and_number(number: int) -> None:
    one = sample_problem(4, number)
    same = sample_problem(4, number)
    other = sample_problem(5, number)
    assert one.scene.document == same.scene.document != other.scene.document
    assert list(map(step_to_dict, one.steps)) == list(map(step_to_dict, same.steps))
    assert (one.number, one.kind) == (number, "scene" if number % 2 else "room")


@pytest.mark.long
def test_problems_have_all_scenes_obstacles_and_kinds_of_steps() -> None:
    problems = [sample_problem(0, number) for number in range(1, 121, 2)]
    names = sorted(list_resources("scenes", "*.yaml"))
    assert [problem.scene.name for problem in problems[: len(names)]] == names
    steps = {type(step).__name__ for problem in problems for step in problem.steps}
    assert steps == {"Actuate", "Grasp", "Place", "Reach", "Touch", "GoTo"}
    assert {len(problem.steps) for problem in problems} == {1, 2}
    added = [sum(name.startswith("random_") for name in p.scene.obstacle_names) for p in problems]
    assert (min(added), max(added)) == (0, 6)


@pytest.mark.long
def test_plans_are_saved_and_judged(tmp_path: Path) -> None:
    table, trials = run_benchmark("random --problems 4", tmp_path)
    assert [trial["key"] for trial in trials] == ["00000", "00001", "00002", "00003"]
    successes = sum(trial["success"] for trial in trials)
    assert successes > 0
    assert f"| all | 4 | {successes} |" in table
    plans = tmp_path / "plans"
    for trial in trials:
        path = plans / f"{trial['key']}.npz"
        saved = Plan.load(path)
        problem = sample_problem(0, trial["number"])
        assert (saved.success, saved.status) == (trial["success"], trial["status"])
        assert saved.scene.document == problem.scene.document
        assert read_plan(path).steps == [step_to_dict(step) for step in saved.steps]

    verdicts = judge_all(sorted(plans.iterdir()))
    assert [verdict.success for verdict in verdicts] == [trial["success"] for trial in trials]
    assert not [verdict for verdict in verdicts if verdict.success and verdict.found]
    write_verdicts(verdicts, plans)
    agreement = (plans / "agreement.md").read_text(encoding="utf-8")
    assert f"| success | success, and nothing found | {successes} |" in agreement

    record = tmp_path / "results.json"
    record_violations(verdicts, record)
    before = record.read_bytes()
    assert json.loads(before)["trials"] == [
        {**trial, "oracle": len(verdict.found)}
        for trial, verdict in zip(trials, verdicts, strict=True)
    ]
    with pytest.raises(ValueError, match="plans and trials are others: 00003"):
        record_violations(verdicts[:-1], record)
    verdicts[0].unjudged = "moved away"
    with pytest.raises(ValueError, match=r"1 plans were not judged, .*00000\.npz"):
        record_violations(verdicts, record)
    assert record.read_bytes() == before


@pytest.mark.long
def test_tasks_in_random_rooms_are_planned_and_saved(tmp_path: Path) -> None:
    table, trials = run_benchmark("random --of rooms --problems 2", tmp_path / "rooms")
    assert [trial["success"] for trial in trials] == [True, True]
    for trial in trials:
        room, steps = random_task(trial["number"])
        saved = Plan.load(tmp_path / "rooms/plans" / f"{trial['key']}.npz")
        assert (saved.scene.document, tuple(saved.steps)) == (room.document, steps)
    assert "# Random rooms, one task each" in table
    with pytest.raises(InputError, match="run otherwise"):  # the folder has other problems
        random_problems.run(problems=2, out=tmp_path / "rooms")
