"""Tests the reader of MoveIt's planning scenes and requests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.moveit_problems import GOAL, JOINTS, POSE, ROBOT, make_request, make_scene, write

import vkc_pin as vkc
from vkc_pin.importing.moveit_problems import list_problems, read_problem


def test_scene_start_and_goal_are_read(tmp_path: Path) -> None:
    (tmp_path / "cage").mkdir()
    files = write(tmp_path / "cage", make_scene(), make_request())
    assert list_problems(tmp_path) == {"cage/0001": files}
    problem = read_problem(*files, ROBOT)
    assert problem.goal == GOAL
    robot = problem.scene.robot
    assert robot.base == "fixed"
    start = dict(zip(robot.coordinates.names, problem.scene.start, strict=True))
    assert [start[name] for name in JOINTS] == [0.3, -1.0, -1.5]
    rest = [name for name in robot.coordinates.names[3:] if name not in JOINTS]
    home = dict(zip(robot.coordinates.names[3:], robot.home, strict=True))
    assert [start[name] for name in rest] == [home[name] for name in rest]
    box, cylinder, ball = problem.scene.document["obstacles"]
    assert [each["name"] for each in (box, cylinder, ball)] == ["shelf", "shelf_1", "shelf_2"]
    assert (box["size"], box["quaternion"]) == ([0.1, 0.2, 0.3], POSE["orientation"])
    assert (cylinder["length"], cylinder["radius"], ball["radius"]) == (0.5, 0.04, 0.06)


def test_objects_are_in_the_frame_of_a_link(tmp_path: Path) -> None:
    scene = make_scene()
    scene["world"]["collision_objects"][0]["header"] = {"frame_id": "wrist_3_link"}
    problem = read_problem(*write(tmp_path, scene, make_request()), ROBOT)
    model, start = problem.scene.robot.model, problem.scene.start
    data, q = model.createData(), problem.scene.robot.coordinates.q(start[None])[0]
    pin.framesForwardKinematics(model, data, q)
    wrist = data.oMf[model.getFrameId("wrist_3_link")]
    expected = wrist.act(np.array(POSE["position"]))
    box = problem.scene.document["obstacles"][0]
    np.testing.assert_allclose(box["position"], expected, atol=1e-9)


def test_problem_can_be_planned(tmp_path: Path) -> None:
    files = write(tmp_path, make_scene(), make_request())
    problem = read_problem(*files, ROBOT, base="omni")
    plan = vkc.plan(problem.scene, [vkc.Configure(problem.goal)])
    assert plan.success
    columns = [plan.trajectory.names.index(name) for name in JOINTS]
    goal = list(problem.goal.values())
    np.testing.assert_allclose(plan.trajectory.positions[-1, columns], goal, atol=1e-3)


def break_type(scene: dict[str, Any], request: dict[str, Any]) -> None:
    scene["world"]["collision_objects"][0]["primitives"][0]["type"] = "cone"


def break_sizes(scene: dict[str, Any], request: dict[str, Any]) -> None:
    scene["world"]["collision_objects"][0]["primitives"][1]["dimensions"] = [0.5]


def break_poses(scene: dict[str, Any], request: dict[str, Any]) -> None:
    scene["world"]["collision_objects"][0]["primitive_poses"].pop()


def add_mesh(scene: dict[str, Any], request: dict[str, Any]) -> None:
    scene["world"]["collision_objects"][0]["meshes"] = [{"vertices": []}]


def name_a_frame(scene: dict[str, Any], request: dict[str, Any]) -> None:
    scene["world"]["collision_objects"][0]["header"] = {"frame_id": "base_lnk"}


def drop_a_position(scene: dict[str, Any], request: dict[str, Any]) -> None:
    request["start_state"]["joint_state"]["position"].pop()


def ask_for_a_pose(scene: dict[str, Any], request: dict[str, Any]) -> None:
    request["goal_constraints"] = [{"position_constraints": [{}]}]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (break_type, ["scene0001.yaml", "primitives[0].type", "'cone'"]),
        (break_sizes, ["scene0001.yaml", "shelf", "2 dimensions", "1"]),
        (break_poses, ["scene0001.yaml", "shelf", "3 poses", "2"]),
        (add_mesh, ["scene0001.yaml", "shelf", "boxes, cylinders and spheres"]),
        (name_a_frame, ["scene0001.yaml", "shelf", "base_lnk", "did you mean 'base_link'"]),
        (drop_a_position, ["request0001.yaml", "joint_state", "4 positions", "3"]),
        (ask_for_a_pose, ["request0001.yaml", "goal_constraints", "joint_constraints"]),
    ],
)
def test_what_is_not_supported_is_named(change: Any, words: list[str], tmp_path: Path) -> None:
    scene, request = make_scene(), make_request()
    change(scene, request)
    with pytest.raises(vkc.InputError) as caught:
        read_problem(*write(tmp_path, scene, request), ROBOT)
    assert all(word in str(caught.value) for word in words)


def test_requests_need_their_scenes(tmp_path: Path) -> None:
    with pytest.raises(vkc.InputError, match="there are no problems in this folder"):
        list_problems(tmp_path)
    scene, _ = write(tmp_path, make_scene(), make_request())
    scene.unlink()
    with pytest.raises(vkc.InputError, match=r"expected: scene0001\.yaml|scene0001\.yaml"):
        list_problems(tmp_path)
