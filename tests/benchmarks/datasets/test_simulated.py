from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.datasets import SMALL

from vkc_pin.benchmarks.throughput import Costs, measure_costs, simulate_workers
from vkc_pin.datasets.dataset import Dataset
from vkc_pin.datasets.recipe import load_recipe


def test_single_worker_is_fully_efficient() -> None:
    simulation = simulate_workers(
        Costs(first=(3.0,), later=(2.0,), client=0.0, episodes=4.0), 1, 10
    )
    assert simulation["efficiency"] == 1.0
    assert simulation["in_vain"] == 0.0
    assert simulation["episodes_per_hour"] == pytest.approx(
        3600.0 * 40.0 / (3.0 + 9 * 2.0), abs=0.1
    )


def test_equal_tasks_waste_time_only_at_the_end() -> None:
    even = simulate_workers(Costs((2.0,), (2.0,), 0.0, 1.0), 10, 100)
    assert even["efficiency"] == 1.0
    odd = simulate_workers(
        Costs((2.0,), (2.0,), 0.0, 1.0), 10, 91
    )  # the last round needs one of ten workers
    assert odd["efficiency"] == pytest.approx(0.91)
    assert odd["in_vain"] == pytest.approx(0.09)


def test_busy_client_limits_the_workers() -> None:
    costs = Costs((2.0,), (2.0,), client=0.1, episodes=1.0)
    few, many = simulate_workers(costs, 10), simulate_workers(costs, 200)  # 20 workers saturate it
    assert few["efficiency"] > 0.95
    assert few["client"] == pytest.approx(0.5, abs=0.03)
    assert many["client"] > 0.99
    assert many["episodes_per_hour"] == pytest.approx(3600.0 / 0.1, rel=0.03)
    assert many["efficiency"] == pytest.approx(0.1, rel=0.1)


def test_costs_are_read_from_the_journal(tmp_path: Path) -> None:
    """A task has two records; a process's first task is the first one in the journal."""
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
        measured = {
            "memory_mb": 1.0,
            "resident_mb": 1.0,
            "process": process,
            "seconds": seconds,
            "client_seconds": client,
        }
        lines.append({"key": str(key), "records": [record], **measured})
    (tmp_path / "journal.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    costs = measure_costs(Dataset(tmp_path, load_recipe(SMALL)))
    assert costs == Costs(first=(6.0, 5.0), later=(2.0,), client=0.6 / 3, episodes=4 / 3)
    assert costs.mean == 2.0
