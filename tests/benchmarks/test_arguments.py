"""Tests that experiments refuse wrong arguments before they write anything."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import vkc_pin as vkc
from tests.benchmarks import bases, gap, scale
from tests.benchmarks.peers import run as peers
from tests.benchmarks.problems import ablation, first_seed, impossible, random_problems, spread
from tests.benchmarks.robot_object_matrix import robots
from tests.benchmarks.robot_object_matrix import run as matrix
from vkc_pin.experiments import chores, door_and_drawer, execution, household, initialization

ONE = {"trials": 1, "seed": 0}
ONE_START = {"starts": 1, "seed": 0}
WRONG: list[tuple[Callable[..., Any], dict[str, Any], str]] = [
    (ablation.run, {"problems": [60]}, "0 to 59"),
    (ablation.run, {"problems": []}, "nothing to run"),
    (ablation.run, {"changes": ["Options.none=1"]}, "none"),
    (ablation.run, {"tasks": ["dor"]}, "did you mean 'door'"),
    (ablation.run, {"tasks": ["door"], "problems": [1]}, "tasks"),
    (ablation.run, {"tasks": ["door"], "starts": 0}, "at least 1"),
    (
        door_and_drawer.run,
        {**ONE, "tasks": ["drawers"]},
        r"no task 'drawers'.*mean 'drawer'",
    ),
    (door_and_drawer.run, {**ONE, "methods": ["B3"]}, r"no method 'B3'.*B1"),
    (door_and_drawer.run, {**ONE, "methods": []}, "methods: there is nothing to run"),
    (door_and_drawer.run, {**ONE, "trials": 0}, r"trials: out of range.*at least 1.*got 0"),
    (bases.run, {"bases": ["diferential"]}, "did you mean 'differential'"),
    (bases.run, {"tasks": ["drawers"]}, "did you mean 'drawer'"),
    (bases.run, {"trials": 0}, "trials"),
    (chores.run, {**ONE, "chores": ("fetsh",)}, "did you mean 'fetch'"),
    (chores.run, {**ONE, "chores": ()}, "chores: there is nothing to run"),
    (execution.run, {"grasp": "glue"}, "glue"),
    (execution.run, {"tasks": ["drawer"], "off": [30.0]}, r"off\[0\]"),
    (execution.run, {"tasks": ["init_1"], "off": [1.0]}, "tasks"),
    (first_seed.run, {"trials": 0}, "trials"),
    (first_seed.run, {"tasks": ["drawr"]}, "did you mean 'drawer'"),
    (gap.run, {"trials": 0}, "trials"),
    (household.run, {**ONE, "tasks": ["fridge"]}, "there is no task 'fridge'"),
    (household.run, {**ONE, "variant": "papers"}, "there is no variant 'papers'"),
    (impossible.run, {"problems": 0}, "at least 1"),
    # The scene has no stick.
    (initialization.run, {**ONE_START, "repeats": 1, "scenes": ["door"]}, "init_1"),
    (
        initialization.run,
        {**ONE_START, "repeats": 1, "scenes": []},
        "scenes: there is nothing to run",
    ),
    (matrix.run, {"starts": 0}, "starts: out of range"),
    (matrix.run, {"robots": ["husky_ur5e", "husky_ur5e"]}, "robots: not a choice"),
    (matrix.run, {"objects": []}, "objects: not a choice"),
    (matrix.run, {"robots": ["husky_ur5"]}, "husky_ur5e"),
    (matrix.run, {"objects": ["ofen_0"]}, "did you mean 'oven_0'"),
    (peers.run, {"methods": ["trajop"]}, "trajopt"),
    (peers.run, {"trials": 0}, "at least 1"),
    (random_problems.run, {"of": "room"}, "rooms"),
    (random_problems.run, {"problems": 0}, "problems"),
    (robots.run, {"goals": 0}, "goals: out of range"),
    (robots.run, {"robots": ["panda", "panda"]}, "robots: not a choice"),
    (robots.run, {"robots": ["/nowhere.urdf"]}, "there is no such file"),
    (robots.run, {"robots": ["pandas"]}, "did you mean 'panda'"),
    (scale.run, {**ONE_START, "counts": ()}, "counts"),
    (scale.run, {**ONE_START, "counts": (0, 10)}, "counts"),
    (scale.run, {**ONE_START, "of": "segments", "counts": (3, 20)}, "counts"),
    (scale.run, {**ONE_START, "of": "doors"}, "obstacles or segments"),
    (spread.run, {"seeds": 1}, "at least 2"),
    (spread.run, {"seeds": True}, "at least 2"),
]


@pytest.mark.parametrize(("run", "arguments", "message"), WRONG)
def test_wrong_arguments_are_refused(
    run: Callable[..., Any], arguments: dict[str, Any], message: str, tmp_path: Path
) -> None:
    if run is execution.run:
        pytest.importorskip("mujoco")
    with pytest.raises(vkc.InputError, match=message):
        run(out=tmp_path / "out", **arguments)
    assert not (tmp_path / "out").exists()
