from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from helpers.datasets import SMALL

from tests.benchmarks.commands import main
from tests.benchmarks.throughput import WORKERS, Costs, measure_costs, run, simulate_workers
from vkc_pin.datasets.dataset import Dataset
from vkc_pin.datasets.recipe import TASKS, load_recipe


def test_single_worker_is_fully_efficient() -> None:
    costs = Costs(first=(3.0,), later=(2.0,), client=0.0, episodes=4.0)
    simulation = simulate_workers(costs, 1, 10)
    assert (simulation["efficiency"], simulation["in_vain"]) == (1.0, 0.0)
    rate = 3600.0 * 40.0 / (3.0 + 9 * 2.0)
    assert simulation["episodes_per_hour"] == pytest.approx(rate, abs=0.1)


@pytest.mark.parametrize(("tasks", "efficiency"), [(100, 1.0), (91, 0.91)])
def test_equal_tasks_waste_time_only_at_the_end(tasks: int, efficiency: float) -> None:
    """The last round of 91 tasks needs one of ten workers."""
    simulation = simulate_workers(Costs((2.0,), (2.0,), 0.0, 1.0), 10, tasks)
    assert simulation["efficiency"] == pytest.approx(efficiency)
    assert simulation["in_vain"] == pytest.approx(1.0 - efficiency)


def test_busy_client_limits_the_workers() -> None:
    costs = Costs((2.0,), (2.0,), client=0.1, episodes=1.0)
    # 20 workers saturate it.
    few = simulate_workers(costs, 10)
    many = simulate_workers(costs, 200)
    assert few["efficiency"] > 0.95
    assert few["client"] == pytest.approx(0.5, abs=0.03)
    assert many["client"] > 0.99
    assert many["episodes_per_hour"] == pytest.approx(3600.0 / 0.1, rel=0.03)
    assert many["efficiency"] == pytest.approx(0.1, rel=0.1)


def test_costs_are_read_from_the_journal(tmp_path: Path) -> None:
    """A process's first task is the first one in the journal."""
    (tmp_path / "recipe.yaml").write_text(json.dumps(SMALL))
    lines: list[object] = [{"settings": {}}, {"session": {"jobs": 2}}]
    for key, process, seconds, client in (
        (0, "a", 5.0, 0.1),
        (1, "a", 1.0, 0.2),
        (2, "b", 4.0, 0.3),
        (3, "b", 1.0, 0.4),
        (4, "a", 2.0, 0.6),
    ):
        record = {"number": key, "success": key != 3, "cpu_time": seconds}
        line = {"key": str(key), "records": [record], "memory_mb": 1.0, "resident_mb": 1.0}
        line |= {"process": process, "seconds": seconds, "client_seconds": client}
        lines.append(line)
    (tmp_path / "journal.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    costs = measure_costs(Dataset(tmp_path, load_recipe(SMALL)))
    assert costs == Costs(first=(6.0, 5.0), later=(2.0,), client=0.6 / 3, episodes=4 / 3)
    assert costs.mean == 2.0


pytest.importorskip("h5py")


@pytest.mark.long
def test_each_task_has_a_record(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recipe = write_recipe(tmp_path)
    out = tmp_path / "out"
    command = f"throughput --episodes 2 --out {out} --recipe {recipe} --quiet"
    assert main(command.split()) == 0
    assert "drive-open" in capsys.readouterr().out
    result = json.loads((out / "results.json").read_text())
    records = result["trials"]
    assert [record["task"] for record in records] == list(TASKS)
    (session,) = result["meta"]["sessions"]
    assert session["trials"] == sum(record["attempts"] for record in records)
    assert {record["commit"] for record in records} == {result["meta"]["commit"]}
    for record in records:
        assert record["workers"] == 1
        assert record["attempts"] >= record["successes"] >= 2
        assert 50.0 < record["memory_mb"] < 2000.0
        assert record["memory_slope_mb"] is None  # too few episodes
        assert 0.0 < record["client_ms"] < 1000.0 * record["wall_time"]
        journal = (out / record["task"] / "journal.jsonl").read_text().splitlines()
        rate = 3600.0 * record["successes"] / json.loads(journal[-1])["seconds"]
        assert record["episodes_per_hour"] == pytest.approx(rate, rel=1e-2)
    assert result["curve"] == []  # one worker only
    simulations = [(one["task"], one["workers"]) for one in result["simulated"]]
    assert simulations == [(task, workers) for task in TASKS for workers in WORKERS]
    assert all(0.0 < one["efficiency"] <= 1.0 for one in result["simulated"])
    assert (out / "workers.png").read_bytes().startswith(b"\x89PNG")
    again = run(out=out, episodes=2, recipe=recipe, progress=False)  # no episode is generated again
    assert [r["attempts"] for r in again["trials"]] == [r["attempts"] for r in records]


@pytest.mark.long
def test_episodes_do_not_depend_on_the_number_of_workers(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    out = tmp_path / "out"
    result = run(out=out, episodes=2, jobs=2, recipe=write_recipe(tmp_path), progress=False)
    assert [(one["task"], one["workers"]) for one in result["curve"]] == [
        (task, count) for task in TASKS for count in (1, 2)
    ]
    for one, two in zip(result["curve"][::2], result["curve"][1::2], strict=True):
        speedup = two["episodes_per_hour"] / one["episodes_per_hour"]
        assert (one["times"], two["times"]) == (1.0, pytest.approx(speedup, abs=1e-3))
        shards = [
            [file.read_bytes() for file in sorted(folder.glob("shards/*/*"))]
            for folder in (out / "1_workers" / one["task"], out / one["task"])
        ]
        assert shards[0] == shards[1]
    assert [one["workers"] for one in result["trials"]] == [2, 2, 2]
    assert "speedup" in (out / "table.md").read_text()


def write_recipe(folder: Path) -> str:
    recipe = folder / "small.yaml"
    recipe.write_text(yaml.safe_dump(SMALL))
    return str(recipe)
