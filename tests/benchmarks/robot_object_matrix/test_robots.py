from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.arm_urdf import write_arms
from helpers.experiments import run_benchmark
from helpers.wheels import format_wheel, write_wheeled_robot

import vkc_pin as vkc
from tests.benchmarks.robot_object_matrix.robots import (
    format_results,
    sample_reachable_poses,
)
from vkc_pin.experiments.harness.record import describe_environment


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> vkc.Robot:
    folder = tmp_path_factory.mktemp("robot")
    return vkc.load_robot(write_arms(folder), tool_frame="hand", height=0.35)


def test_poses_are_above_the_floor_and_reproducible(robot: vkc.Robot) -> None:
    def sample(name: str, count: int, **seed: int) -> np.ndarray:
        return np.array(
            [one.homogeneous for one in sample_reachable_poses(robot, name, count, **seed)]
        )

    poses = sample("one", 8)
    assert (poses[:, 2, 3] > vkc.Options().dist_safe).all()
    np.testing.assert_array_equal(sample("one", 8, seed=0), poses)
    np.testing.assert_array_equal(sample("one", 3), poses[:3])
    for others in (sample("two", 8), sample("one", 8, seed=1)):
        differences = np.abs(poses[:, None] - others).max(axis=(2, 3))
        assert differences.min() > 1e-3


@pytest.mark.long
def test_command_records_reached_poses_and_a_failed_import(tmp_path: Path) -> None:
    valid = write_arms(tmp_path / "good")
    legless = tmp_path / "legless.urdf"
    box = "<collision><geometry><box size='1 1 1'/></geometry></collision>"
    legless.write_text(f"<robot name='legless'><link name='a'>{box}</link></robot>")
    out = tmp_path / "out"
    table, records = run_benchmark(f"robots --goals 2 --robots {valid} {legless}", out)
    failures = [(r["robot"], r["status"]) for r in records if not r["success"]]
    assert failures == [("legless", "not imported")]
    reached = [r for r in records if r["robot"] == "robot"]
    assert [(r["success"], r["violations"], r["number"]) for r in reached] == [
        (True, [], 0),
        (True, [], 1),
    ]
    assert all(r["base_path_length"] + r["arm_path_length"] > 0.1 for r in reached)
    assert reached[0]["home_room"] >= 0.03
    assert reached[0]["joints"] == 5
    assert reached[0]["base"] == "omni"
    assert "| robot | omni | 5 |" in table
    assert reached[0]["load_time"] > 0.0
    assert "no arm was found" in table
    assert "| 2/2 |" in table
    assert vkc.load_robot(out / "robots" / "robot").home.tolist() != []


@pytest.mark.long
def test_robot_with_unsteered_wheels_does_not_slide(tmp_path: Path) -> None:
    wheels = (format_wheel("left_wheel", 0.0, 0.25), format_wheel("right_wheel", 0.0, -0.25))
    file = write_wheeled_robot(tmp_path / "rover", *wheels)
    out = tmp_path / "out"
    table, records = run_benchmark(f"robots --goals 1 --robots {file}", out)
    assert [(r["base"], r["success"]) for r in records] == [("differential", True)]
    assert "| robot | differential | 5 |" in table


def test_report_lists_failures_by_robot() -> None:
    meta = describe_environment(robots=["one", "two"], goals=2, seed=0, time_limit=5.0)
    facts = {"import_time": 4.0, "load_time": 0.5, "joints": 6, "pairs": 7, "home_room": -0.004}
    facts |= {"base": "ackermann"}
    failed = {**facts, "success": False}
    infeasible = {"status": "infeasible", "planning_time": 3.0, "violations": ["too deep"]}
    unplanned = {"home_room": None, "status": "hardly free", "because": "only 1 of 9"}
    trials = [
        {"robot": "one", **facts, "success": True, "status": "success", "planning_time": 1.0},
        {"robot": "one", **failed, **infeasible},
        {"robot": "two", **failed, **unplanned},
    ]
    text = format_results({"meta": meta, "trials": trials})
    assert "| one | ackermann | 6 | 7 | 4.00 | 0.50 | -4 | 1/2 | 2.00 | 2.90 |" in text
    assert "| two | ackermann | 6 | 7 | 4.00 | 0.50 | – | – |" in text
    assert "| one | infeasible | too deep |" in text
    assert "| two | hardly free | only 1 of 9 |" in text
