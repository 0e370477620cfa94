"""Tests the robot–object matrix: its tables, its chart and its command."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from helpers.experiments import run_benchmark

import vkc_pin as vkc
from tests.benchmarks.robot_object_matrix.pairs import SHARE
from tests.benchmarks.robot_object_matrix.run import chart, format_results
from vkc_pin.experiments.harness.record import describe_environment


def make_record(robot: str, name: str, status: str = "success", **fields: Any) -> dict[str, Any]:
    record = {"robot": robot, "object": name, "success": status == "success", "status": status}
    if status not in ("unreachable", "error", "no hand"):
        record |= {"planning_time": 1.0, "load_time": 0.5, "base": "omni"}
    return {**record, **fields}


NO_GRASP = "turn: nothing of it fits"
NO_HAND = "touch_links: not known"
RECORDS = [
    make_record("one", "oven_0", planning_time=1.0),
    make_record("one", "oven_0", planning_time=3.0),
    make_record("one", "door", because=""),
    make_record("one", "door", "infeasible", because="the shelf | the wall"),
    make_record("one", "valve_1", "unreachable", because=NO_GRASP),
    make_record("two", "oven_0", "not converged", because=""),
    make_record("two", "oven_0", "not converged", because=""),
    make_record("two", "door", "error", violations=["InputError: no"]),
    make_record("two", "valve_1", "unreachable", because=NO_GRASP),
    *(make_record("three", name, "no hand", because=NO_HAND) for name in ("oven_0", "door")),
    make_record("three", "valve_1", "no hand", because=NO_HAND),
]


def test_tables_list_all_pairs() -> None:
    text = format_results(
        {
            "meta": {**describe_environment(starts=2, seed=0, share=0.5, max_evaluations=1000)},
            "trials": RECORDS,
        }
    )
    assert "3 robots, 3 objects of 3 kinds, 2 random starts each" in text
    assert "A joint is opened by 50% of its range" in text
    assert "| one | omni | 3 | 2 | 1 (50%) | 2 (100%) | 1.00 | 2.70 | 0.50 |" in text
    assert "| two | omni | 3 | 2 | 0 (0%) | 0 (0%) | 1.00 | 1.00 | 0.50 |" in text, (
        "an error is a failure"
    )
    assert "| all | omni | 9 | 4 | 1 (25%) | 2 (50%) |" in text
    assert "| oven_0 | 2/2 | 0/2 | – |\n| door | 1/2 | ! | – |\n| valve_1 | – | – | – |" in text
    assert "| one | door | infeasible | 1 | the shelf \\| the wall |" in text
    assert "| two | oven_0 | not converged | 2 |  |" in text, "equal failures share a row"
    assert "| two | door | error | 1 | InputError: no |" in text
    assert "| three | every object | no hand | 3 | touch_links: not known |" in text
    assert "| three | – | 3 | 0 | 0 (0%) | 0 (0%) | – | – | – |" in text
    assert (
        text.index("## What failed")
        < text.index("## Out of reach")
        < text.index("| one | valve_1 | unreachable")
    )


def test_chart_shows_the_successes_of_all_pairs(tmp_path: Path) -> None:
    axes, _ = chart(RECORDS, tmp_path / "success.png").axes
    texts = [text.get_text() for text in axes.texts]
    assert texts == ["2/2", "0/2", "–", "1/2", "!", "–", "–", "–", "–"]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["oven_0", "door", "valve_1"]
    rates = axes.images[0].get_array()
    assert rates.tolist() == [[100.0, 0.0, None], [50.0, 0.0, None], [None, None, None]]
    assert (tmp_path / "success.png").stat().st_size > 5000


@pytest.mark.long
def test_command_opens_a_drawer(tmp_path: Path) -> None:
    drawers = vkc.load_object(vkc.procedural.random_object("drawers", 0))
    arguments = "anything --starts 1 --robots husky_ur5e --objects drawers_0"
    table, (opened,) = run_benchmark(arguments, tmp_path)
    assert "| drawers_0 | 1/1 |" in table
    assert "| husky_ur5e | omni | 1 | 1 |" in table
    assert opened["base"] == "omni"
    assert (tmp_path / "success.png").stat().st_size > 5000
    assert (opened["success"], opened["violations"], opened["kind"]) == (True, [], "drawers")
    reach = (drawers.upper - drawers.lower)[drawers.coordinates.index(opened["joint"])]
    assert opened["goal"] == pytest.approx(SHARE * reach, abs=1e-3)
    assert opened["base_path_length"] > 0.5, "the robot starts 2 m away"
