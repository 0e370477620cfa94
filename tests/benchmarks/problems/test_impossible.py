"""Tests that impossible problems are recognised and explained."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.experiments import run_benchmark

import vkc_pin as vkc
from tests.benchmarks.problems.impossible import KINDS, sample_impossible_problem


@pytest.mark.parametrize(
    "kind", ["beam too low", "place taken", "pose too high", "joint beyond its limit"]
)
def test_infeasibility_is_proven(kind: str) -> None:
    scene, steps = KINDS[kind](np.random.default_rng(1))
    plan = vkc.plan(scene, steps)
    assert plan.status == "infeasible"
    proven = any("proven: " in note for note in plan.report.notes)
    assert proven or kind == "joint beyond its limit"


def test_problems_are_determined_by_their_numbers() -> None:
    for number in range(len(KINDS)):
        one = sample_impossible_problem(7, number)
        other = sample_impossible_problem(7, number)
        assert one[0].document == other[0].document
        assert one[1][0].__class__ is other[1][0].__class__


def test_trials_are_explained_and_proven_infeasible(tmp_path: Path) -> None:
    table, trials = run_benchmark("impossible --problems 4", tmp_path)
    kinds = ["closed wall", "fence round the start", "fence round the goal", "gap too narrow"]
    assert [t["kind"] for t in trials] == kinds
    for t in trials:
        assert (t["success"], t["explained"], t["proven"]) == (False, True, True)
        assert "proven: " in t["notes"][0]
        assert t["notes"][0] in table
        assert t["wall_time"] > 0.0
