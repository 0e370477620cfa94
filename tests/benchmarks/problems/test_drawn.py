"""Problems drawn at random: the same in every run, of all kinds, and their plans are kept and judged."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from oracle.agreement import judged, recorded, written
from oracle.plan import read_plan

from vkc_pin.benchmarks.problems import random_problems
from vkc_pin.benchmarks.problems.drawn import drawn
from vkc_pin.cli import main
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.planning.plan import Plan
from vkc_pin.procedural.tasks import random_task
from vkc_pin.world.files.resources import list_resources
from vkc_pin.world.task.steps import step_to_dict


def test_problems_follow_from_their_numbers() -> None:
    for number in (1, 6):
        one, same, other = drawn(4, number), drawn(4, number), drawn(5, number)
        assert one.scene.document == same.scene.document != other.scene.document
        assert list(map(step_to_dict, one.steps)) == list(map(step_to_dict, same.steps))
        assert (one.number, one.kind) == (number, "scene" if number % 2 else "room")


def test_all_scenes_take_turns_with_obstacles_and_all_kinds_of_steps() -> None:
    problems = [drawn(0, number) for number in range(1, 121, 2)]
    names = sorted(list_resources("scenes", "*.yaml"))
    assert [own.scene.name for own in problems[: len(names)]] == names
    steps = {type(step).__name__ for own in problems for step in own.steps}
    assert steps == {"Actuate", "Grasp", "Place", "Reach", "Touch", "GoTo"}
    assert {len(own.steps) for own in problems} == {1, 2}
    more = [
        sum(name.startswith("random_") for name in own.scene.obstacle_names) for own in problems
    ]
    assert (min(more), max(more)) == (0, 6)


def test_plans_are_kept_and_judged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "random"
    command = ["bench", "random", "--problems", "4", "--seed", "0", "--quiet", "--out", str(out)]
    assert main(command) == 0
    table = (out / "table.md").read_text(encoding="utf-8")
    assert table in capsys.readouterr().out
    trials = json.loads((out / "results.json").read_text(encoding="utf-8"))["trials"]
    assert [trial["key"] for trial in trials] == ["00000", "00001", "00002", "00003"]
    good = sum(trial["success"] for trial in trials)
    assert good > 0
    assert f"| all | 4 | {good} |" in table
    for trial in trials:
        path = out / "plans" / f"{trial['key']}.npz"
        kept, problem = Plan.load(path), drawn(0, trial["number"])
        assert (kept.success, kept.status) == (trial["success"], trial["status"])
        assert kept.scene.document == problem.scene.document
        assert read_plan(path).steps == [step_to_dict(step) for step in kept.steps]

    verdicts = judged(sorted((out / "plans").iterdir()))
    assert [verdict.success for verdict in verdicts] == [trial["success"] for trial in trials]
    assert not [verdict for verdict in verdicts if verdict.success and verdict.found]
    written(verdicts, out / "plans")
    lines = (out / "plans" / "verdicts.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["path"] for line in lines] == [
        f"{trial['key']}.npz" for trial in trials
    ]
    assert f"| success | success, and nothing found | {good} |" in (
        out / "plans" / "agreement.md"
    ).read_text(encoding="utf-8")

    record = out / "results.json"
    recorded(verdicts, record)
    noted = json.loads(record.read_text(encoding="utf-8"))["trials"]
    assert [trial.pop("oracle") for trial in noted] == [len(verdict.found) for verdict in verdicts]
    assert noted == trials
    kept_record = record.read_bytes()
    with pytest.raises(ValueError, match="plans and trials are others: 00003"):
        recorded(verdicts[:-1], record)
    verdicts[0].unjudged = "moved away"
    with pytest.raises(ValueError, match=r"1 plans were not judged, .*00000\.npz"):
        recorded(verdicts, record)
    assert record.read_bytes() == kept_record

    before = (out / "trials.jsonl").read_bytes()
    assert main(command) == 0  # nothing is left to do
    assert (out / "trials.jsonl").read_bytes() == before
    with pytest.raises(InputError, match="problems"):
        random_problems.run(problems=0, out=tmp_path / "none")


def test_one_task_in_each_of_some_rooms(tmp_path: Path) -> None:
    out = tmp_path / "rooms"
    assert (
        main(["bench", "random", "--of", "rooms", "--problems", "3", "--quiet", "--out", str(out)])
        == 0
    )
    trials = json.loads((out / "results.json").read_text(encoding="utf-8"))["trials"]
    assert [trial["success"] for trial in trials] == [True, True, True]
    for trial in trials:
        room, steps = random_task(trial["number"])
        kept = Plan.load(out / "plans" / f"{trial['key']}.npz")
        assert (kept.scene.document, tuple(kept.steps)) == (room.document, steps)
        assert trial["kind"] in {placed.object.name for placed in room.objects.values()}
    verdicts = judged(sorted((out / "plans").iterdir()))
    assert [verdict.found for verdict in verdicts] == [[], [], []]
    assert "# Random rooms, one task each" in (out / "table.md").read_text(encoding="utf-8")
    with pytest.raises(InputError, match="run otherwise"):  # the folder is of other problems
        random_problems.run(problems=3, out=out)
    with pytest.raises(UnknownNameError, match="rooms"):
        random_problems.run(of="room", out=tmp_path / "none")
