"""Tests the experiment with arms in clutter."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import pytest
from helpers.moveit_problems import ROBOT, make_request, make_scene, write

from tests.benchmarks import arms
from vkc_pin.experiments.harness.record import describe_environment
from vkc_pin.importing.moveit_problems import list_problems, read_problem

ROOT = Path(__file__).parents[2]


def make_record(method: str, length: float, **changes: Any) -> dict[str, Any]:
    same = {"problem": "box/0001", "base": "fixed", "goal": "joints", "status": "success"}
    times = {"time_final": 1.0, "time_own": 0.5, "duration": 4.0, "joint_length": length}
    usual = {"valid": True, "success": True, "violations": []}
    return {**same, **times, **usual, "method": method, **changes}


def test_problem_is_planned_to_joint_values_and_to_the_pose_there(tmp_path: Path) -> None:
    write(tmp_path, make_scene(), make_request())
    found = arms.run(
        out=tmp_path / "out",
        folder=str(tmp_path),
        robot=ROBOT,
        methods=["VKC"],
        bases=["fixed", "omni"],
        goals=["joints", "pose"],
        progress=False,
    )
    records = found["trials"]
    assert [r["key"] for r in records] == [
        f"0001/{base}/{goal}/VKC" for base in ("fixed", "omni") for goal in ("joints", "pose")
    ]
    for record in records:
        assert record["valid"]
        assert record["success"]
        assert record["least_distance"] > 0.0
        assert record["joint_length"] > 0.1
    assert "1 of 1" in (tmp_path / "out" / "table.md").read_text(encoding="utf-8")


def test_table_compares_lengths_and_leaves_out_what_is_invalid() -> None:
    records = [
        make_record("VKC", 3.0),
        make_record("roboplan", 4.0),
        make_record("OMPL", 5.0),
        make_record("VKC", 1.0, problem="box/0002", valid=False, success=False),
        make_record("OMPL", 1.0, problem="box/0003", success=False, status="timed out"),
    ]
    meta = describe_environment(
        problems=3,
        robot="fetch",
        seed=0,
        methods=list(arms.METHODS),
        bases=["fixed"],
        goals=["joints"],
        time_limit=60.0,
        clearance=0.002,
        peers={"ompl": "2"},
    )
    table = arms.format_results({"meta": meta, "trials": records})
    assert "the others, 1 problems: median 0.75, largest 0.75" in table
    assert "not counted: box/0002." in table
    assert "- box/0003, fixed, joints, OMPL: timed out" in table
    assert "box/0002, fixed" not in table


@pytest.mark.parametrize(("name", "value"), [("methods", ["RRT"]), ("bases", ["wheels"])])
def test_unknown_choices_are_named(name: str, value: list[str], tmp_path: Path) -> None:
    write(tmp_path, make_scene(), make_request())
    more: dict[str, Any] = {name: value}
    with pytest.raises(Exception, match=value[0]):
        arms.run(out=tmp_path / "out", folder=str(tmp_path), robot=ROBOT, **more)


def test_problem_is_posed_to_another_arm(tmp_path: Path) -> None:
    script = runpy.run_path(str(ROOT / "docs/make_arm_problems.py"))
    scene = make_scene()
    (shelf,) = scene["world"]["collision_objects"]
    shelf["primitives"] = [{"type": "box", "dimensions": [0.1, 1.0, 0.1]}] * 2
    upper = {"position": [0.7, 0.0, 0.9], "orientation": [0.0, 0.0, 0.0, 1.0]}
    shelf["primitive_poses"] = [upper, {**upper, "position": [0.7, 0.0, 0.5]}]
    given = tmp_path / "given"
    made = tmp_path / "made"
    given.mkdir()
    write(given, scene, make_request())
    script["main"](str(given), ROBOT, "panda", str(made))
    problem = read_problem(*list_problems(made)["0001"], "panda")
    found = arms.run(
        out=tmp_path / "out", folder=str(made), robot="panda", methods=["VKC"], progress=False
    )
    (record,) = found["trials"]
    assert record["valid"]
    assert record["success"]
    assert len(problem.goal) == 7
    tool = problem.scene.with_start(arm=dict(problem.goal)).tool_placement().translation
    above, below = (shape.placement.translation for shape in problem.scene.obstacles)
    assert below[2] - 0.05 < tool[2] < above[2] + 0.05
    assert above[2] - below[2] == pytest.approx(0.4)
