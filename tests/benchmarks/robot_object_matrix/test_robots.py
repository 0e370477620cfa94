from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.arm_urdf import write_arms

import vkc_pin as vkc
from vkc_pin.benchmarks.robot_object_matrix.robots import (
    format_results,
    sample_reachable_poses,
)
from vkc_pin.cli import main


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> vkc.Robot:
    folder = tmp_path_factory.mktemp("robot")
    return vkc.load_robot(write_arms(folder), tool_frame="hand", height=0.35)


def test_poses_are_above_the_floor_and_reproducible(robot: vkc.Robot) -> None:
    poses = sample_reachable_poses(robot, "one", 8)
    assert all(pose.translation[2] > vkc.Options().dist_safe for pose in poses)
    same, other_name, other_seed = (
        sample_reachable_poses(robot, *arguments, seed=seed)
        for *arguments, seed in (("one", 8, 0), ("two", 8, 0), ("one", 8, 1))
    )
    assert all(a.isApprox(b, 0.0) for a, b in zip(poses, same, strict=True))
    for others in (other_name, other_seed):
        assert not any(a.isApprox(b, 1e-3) for a in poses for b in others)
    assert all(
        a.isApprox(b, 0.0)
        for a, b in zip(poses, sample_reachable_poses(robot, "one", 3), strict=False)
    ), "a smaller sample is the beginning of a larger one"


@pytest.mark.long
def test_command_records_reached_poses_and_a_failed_import(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    valid = write_arms(tmp_path / "good")
    legless = tmp_path / "legless.urdf"
    box = "<link name='{}'><collision><geometry><box size='1 1 1'/></geometry></collision></link>"
    legless.write_text(f"<robot name='legless'>{box.format('a')}</robot>", encoding="utf-8")
    out = tmp_path / "out"
    command = [
        "bench",
        "robots",
        "--goals",
        "2",
        "--robots",
        str(valid),
        str(legless),
        "--quiet",
        "--out",
        str(out),
    ]
    assert main(command) == 0
    table = (out / "table.md").read_text(encoding="utf-8")
    assert table in capsys.readouterr().out
    records = json.loads((out / "results.json").read_text(encoding="utf-8"))["trials"]
    assert [(r["robot"], r["status"]) for r in records if not r["success"]] == [
        ("legless", "not imported")
    ]
    reached = [r for r in records if r["robot"] == "robot"]
    assert [(r["success"], r["violations"], r["number"]) for r in reached] == [
        (True, [], 0),
        (True, [], 1),
    ]
    assert all(r["base_path_length"] + r["arm_path_length"] > 0.1 for r in reached), (
        "the robot moves"
    )
    assert reached[0]["home_room"] >= 0.03
    assert reached[0]["joints"] == 5
    assert reached[0]["load_time"] > 0.0
    assert "no arm was found" in table
    assert "| 2/2 |" in table
    assert vkc.load_robot(out / "robots" / "robot").home.tolist() != []

    journal = (out / "trials.jsonl").read_bytes()
    assert main(command) == 0
    assert (out / "trials.jsonl").read_bytes() == journal, "no trial was run again"


def test_report_lists_failures_by_robot() -> None:
    meta = {"robots": ["one", "two"], "goals": 2, "seed": 0, "time_limit": 5.0, "versions": {}}
    meta["machine"] = {"cores": 2, "processor": "x", "machine": "x", "system": "x", "python": "3"}
    facts = {"import_time": 4.0, "load_time": 0.5, "joints": 6, "pairs": 7, "home_room": -0.004}
    trials = [
        {"robot": "one", **facts, "success": True, "status": "success", "planning_time": 1.0},
        {
            "robot": "one",
            **facts,
            "success": False,
            "status": "infeasible",
            "planning_time": 3.0,
            "violations": ["too deep"],
        },
        {
            "robot": "two",
            **facts,
            "home_room": None,
            "success": False,
            "status": "hardly free",
            "because": "only 1 of 9",
        },
    ]
    text = format_results({"meta": meta, "trials": trials})
    assert "| one | 6 | 7 | 4.00 | 0.50 | -4 | 1/2 | 2.00 | 2.90 |" in text
    assert "| two | 6 | 7 | 4.00 | 0.50 | – | – |" in text
    assert "| one | infeasible | too deep |" in text
    assert "| two | hardly free | only 1 of 9 |" in text
