"""Tests that joint goals become intervals of the robot's coordinates, and errors of wrong ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.drives import make_hall
from helpers.expected_errors import expect_error
from helpers.telescopes import write_coupled_scene
from hypothesis import given
from hypothesis import strategies as st

from vkc_pin.options import Options
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.steps import Configure, Reach

SIX = [0.5, -1.2, 1.5, -1.0, 1.5, 0.3]  # a pose, or values of the arm's six joints


def compile_goal(scene: Scene, step: Configure) -> dict[str, tuple[float, float]]:
    """Return the goal intervals of a single step."""
    (phase,) = compile_task(scene, [step], Options()).phases
    assert phase.kind == "configure"
    return dict(phase.configuration)


def test_tolerances_are_those_of_the_step() -> None:
    step = Configure({"base_x": 1.0, "elbow_joint": -0.5}, {"elbow_joint": 0.2})
    goal = compile_goal(make_hall(), step)
    assert goal == {"base_x": (1.0, 1.0), "elbow_joint": (-0.7, -0.3)}
    wide = compile_goal(make_hall(), Configure({"elbow_joint": 3.0}, 0.5))
    assert wide["elbow_joint"] == (2.5, pytest.approx(np.pi, abs=1e-6))  # the joint's limit


@pytest.fixture(scope="module")
def coupled_scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return write_coupled_scene(tmp_path_factory.mktemp("robot"))


@given(leader=st.floats(0.0, 0.4), tolerance=st.floats(0.0, 0.01))
def test_coupled_joints_are_goals_of_their_leader(
    coupled_scene: Scene, leader: float, tolerance: float
) -> None:
    scene = coupled_scene
    lower, upper = scene.robot.lower, scene.robot.upper
    column = scene.robot.coordinates.index("out_1")
    leader = float(np.clip(leader, lower[column], upper[column]))
    follower = -0.5 * leader + 0.15  # out_3
    goal = compile_goal(scene, Configure({"out_3": follower}, tolerance))
    assert goal.keys() == {"out_1"}
    wanted = np.clip(leader + np.array([-2.0, 2.0]) * tolerance, lower[column], upper[column])
    np.testing.assert_allclose(goal["out_1"], wanted, atol=1e-9)
    both = compile_goal(scene, Configure({"out_1": leader, "out_3": follower}))
    np.testing.assert_allclose(both["out_1"], leader, atol=1e-9)


@pytest.mark.parametrize(
    ("joints", "field", "problem", "nearest"),
    [
        ({"elbow": 1.0}, "elbow", "there is no joint", "elbow_joint"),
        ({"elbow_joint": 3.2}, "elbow_joint", "outside the joint's limits", None),
        ({"base_x": 6.1}, "base_x", "outside the arena", None),
        ({"gripper_left_finger_joint": 0.01}, "gripper_left_finger_joint", "there is no", None),
    ],
)
def test_wrong_joints_are_refused(
    joints: dict[str, float], field: str, problem: str, nearest: str | None
) -> None:
    attributes: dict[str, Any] = {} if nearest is None else {"nearest": nearest}
    with expect_error(problem, field=f"steps[0].joints[{field!r}]", **attributes):
        compile_goal(make_hall(), Configure(joints))


def test_values_within_a_tolerance_of_the_limits_are_allowed() -> None:
    assert compile_goal(make_hall(), Configure({"elbow_joint": 3.1416}))  # π, rounded
    assert compile_goal(make_hall(), Configure({"elbow_joint": 3.2}, 0.1))
    with expect_error("outside the joint's limits"):
        compile_goal(make_hall(), Configure({"elbow_joint": 3.3}, 0.1))


def test_coupled_joints_must_agree(tmp_path: Path) -> None:
    scene = write_coupled_scene(tmp_path)
    with expect_error("the coupled joints of 'out_1' contradict each other"):
        compile_goal(scene, Configure({"out_1": 0.1, "out_2": 0.06}))
    assert compile_goal(scene, Configure({"out_1": 0.1, "out_2": 0.06}, {"out_2": 0.011}))


def test_locked_joints_are_named(tmp_path: Path) -> None:
    scene = write_coupled_scene(tmp_path, more="locked_joints: {lift: 0.4}\n")
    assert "lift" not in scene.robot.coordinates.names
    with expect_error("joint 'lift' is locked", field="steps[0].joints['lift']"):
        compile_goal(scene, Configure({"lift": 0.5}))


def test_fixed_bases_stay() -> None:
    scene = make_hall(base="fixed")
    assert compile_goal(scene, Configure({"base_x": 0.0, "elbow_joint": 1.0}))["base_x"] == (0, 0)
    with expect_error("outside the place of the fixed base", field="steps[0].joints['base_x']"):
        compile_goal(scene, Configure({"base_x": 0.5}))


def test_lists_that_may_be_joint_values_are_no_poses() -> None:
    for pose in (SIX, np.array(SIX)):
        with expect_error("as a pose .* and as values of the joints", field="steps[0].pose"):
            compile_task(make_hall(), [Reach(pose)], Options())
    beyond = [0.5, 0.2, 6.5, 0.0, 0.0, 0.0]  # beyond the elbow's limits
    for meant in (tuple(SIX), beyond, Reach(tuple(SIX)).pose):
        assert compile_task(make_hall(), [Reach(meant)], Options()).phases[0].kind == "reach"
    with expect_error("Configure", field="Reach.pose"):
        Reach({"elbow_joint": 1.0})
