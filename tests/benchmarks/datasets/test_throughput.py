from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from helpers.datasets import SMALL

from vkc_pin.benchmarks.throughput import WORKERS, run
from vkc_pin.cli import main
from vkc_pin.datasets.recipe import TASKS

pytest.importorskip("h5py")


@pytest.mark.long
def test_each_task_has_a_record(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recipe = write_recipe(tmp_path)
    out = tmp_path / "out"
    assert (
        main(
            [
                "bench",
                "throughput",
                "--episodes",
                "2",
                "--out",
                str(out),
                "--recipe",
                recipe,
                "--quiet",
            ]
        )
        == 0
    )
    assert "drive-open" in capsys.readouterr().out
    result = json.loads((out / "results.json").read_text())
    records = result["trials"]
    assert [record["task"] for record in records] == list(TASKS)
    (session,) = result["meta"]["sessions"]
    assert session["trials"] == sum(record["attempts"] for record in records)
    assert {record["commit"] for record in records} == {result["meta"]["commit"]}
    for record in records:
        assert {
            "task",
            "episodes_per_hour",
            "attempts",
            "successes",
            "workers",
            "memory_mb",
        } <= set(record)
        assert record["workers"] == 1
        assert record["attempts"] >= record["successes"] >= 2
        assert record["episodes_per_hour"] > 0.0
        assert 50.0 < record["memory_mb"] < 2000.0
        assert record["memory_slope_mb"] is None  # too few episodes
        assert 0.0 < record["client_ms"] < 1000.0 * record["wall_time"]
        lines = (out / record["task"] / "journal.jsonl").read_text().splitlines()[1:]
        seconds = [
            json.loads(line)["seconds"] for line in lines if "session" not in json.loads(line)
        ]
        assert record["episodes_per_hour"] == pytest.approx(
            3600.0 * record["successes"] / seconds[-1], rel=1e-2
        )
    assert result["curve"] == []  # one worker only
    for task in TASKS:
        simulations = [one for one in result["simulated"] if one["task"] == task]
        assert [one["workers"] for one in simulations] == list(WORKERS)
        assert all(0.0 < one["efficiency"] <= 1.0 for one in simulations)
    assert (out / "workers.png").read_bytes().startswith(b"\x89PNG")
    again = run(out=out, episodes=2, recipe=recipe, progress=False)  # no episode is generated again
    assert [r["attempts"] for r in again["trials"]] == [r["attempts"] for r in records]


@pytest.mark.long
def test_episodes_do_not_depend_on_the_number_of_workers(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    result = run(
        out=tmp_path / "out", episodes=2, jobs=2, recipe=write_recipe(tmp_path), progress=False
    )
    assert [(one["task"], one["workers"]) for one in result["curve"]] == [
        (task, count) for task in TASKS for count in (1, 2)
    ]
    for one, two in zip(result["curve"][::2], result["curve"][1::2], strict=True):
        assert one["times"] == 1.0
        assert two["times"] == pytest.approx(
            two["episodes_per_hour"] / one["episodes_per_hour"], abs=1e-3
        )
        folders = tmp_path / "out/1_workers" / one["task"], tmp_path / "out" / one["task"]
        shards = [
            [file.read_bytes() for file in sorted(folder.glob("shards/*/*"))] for folder in folders
        ]
        assert shards[0] == shards[1]
    assert [one["workers"] for one in result["trials"]] == [2, 2, 2]
    assert "speedup" in (tmp_path / "out/table.md").read_text()


def write_recipe(folder: Path) -> str:
    recipe = folder / "small.yaml"
    recipe.write_text(yaml.safe_dump(SMALL))
    return str(recipe)
