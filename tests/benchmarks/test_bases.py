"""Tests the comparison of base kinematics at a door and a drawer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.experiments import run_benchmark

from tests.benchmarks import bases
from vkc_pin import InputError
from vkc_pin.experiments.harness.record import describe_environment


def test_starts_are_the_same_for_every_base() -> None:
    scenes = [bases.make_start("door", base, 3, 7) for base in bases.BASES]
    assert [scene.robot.base for scene in scenes] == ["omni", "differential", "ackermann"]
    assert scenes[-1].robot.turning_radius == bases.TURNING_RADIUS
    for scene in scenes[1:]:
        np.testing.assert_array_equal(scene.start, scenes[0].start)
    assert not np.array_equal(bases.make_start("door", "omni", 3, 8).start, scenes[0].start)


def test_starts_of_another_robot_are_the_same_for_every_base() -> None:
    scenes = [bases.make_start("drawer", base, 3, 7, "panda") for base in bases.BASES]
    assert [scene.robot.name for scene in scenes] == ["panda"] * 3
    assert [scene.robot.base for scene in scenes] == list(bases.BASES)
    for scene in scenes[1:]:
        np.testing.assert_array_equal(scene.start, scenes[0].start)


def test_robots_of_one_name_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"robots: .*robots of different names.*husky_ur5e"):
        bases.run(out=tmp_path, robots=["husky_ur5e", "husky_ur5e"])


@pytest.mark.long
def test_both_bases_open_the_drawer(tmp_path: Path) -> None:
    arguments = "bases --trials 1 --tasks drawer --bases omni differential"
    table, records = run_benchmark(arguments, tmp_path)
    assert [(r["base"], r["success"]) for r in records] == [("differential", True), ("omni", True)]
    for r in records:
        assert f"| husky_ur5e | drawer | {r['base']} | 1 of 1 | {r['planning_time']:.3f} |" in table
        assert (
            f"| {r['base_path_length']:.2f} | {r['arm_path_length']:.2f} | {r['duration']:.2f} |"
            in table
        )


TIMES = dict.fromkeys(
    (
        "planning_time",
        "evaluations",
        "iterations",
        "duration",
        "base_path_length",
        "arm_path_length",
    ),
    1.0,
)


def test_failures_are_listed() -> None:
    meta = {"starts": 5, "seed": 0, "radius": 0.8, "tasks": ["door"], "bases": ["ackermann"]}
    meta["robots"] = ["husky"]
    failure = {"robot": "husky", "task": "door", "base": "ackermann", "number": 4, "success": False}
    failure |= {"status": "rejected", "violations": ["turning base"], **TIMES}
    text = bases.format_results({"meta": {**describe_environment(), **meta}, "trials": [failure]})
    assert "- husky, door, ackermann, start 4: rejected; turning base" in text
    assert "| husky | door | ackermann | 0 of 1 |" in text
