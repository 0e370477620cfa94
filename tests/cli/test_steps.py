"""Tests the options of `vkc-pin plan` that are steps."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.commands import RunCommand
from helpers.expected_errors import expect_error

import vkc_pin as vkc
from vkc_pin.cli.commands import make_parser
from vkc_pin.cli.steps import make_steps, parse_settings
from vkc_pin.world.task.steps import step_to_dict

POSE = (0.1, -0.2, 0.3, 0.0, 0.5, -1.0)


def list_data(*steps: vkc.Step) -> list[dict[str, object]]:
    return [step_to_dict(step) for step in steps]


def parse_steps(words: str) -> list[dict[str, object]]:
    """Return the steps of a command line as plain data."""
    arguments = make_parser().parse_args(["plan", "scene", *words.split()])
    return list_data(*make_steps(arguments.steps or ()))


def test_consecutive_settings_of_an_object_become_one_step() -> None:
    settings = ["door.knob=0.5", "door.hinge=1.2", "drawer.slide=0.3", "door.hinge=0"]
    assert parse_settings([*settings, "door.hinge = 1"]) == [
        vkc.Actuate("door", {"knob": 0.5, "hinge": 1.2}),
        vkc.Actuate("drawer", {"slide": 0.3}),
        vkc.Actuate("door", {"hinge": 0.0}),
        vkc.Actuate("door", {"hinge": 1.0}),
    ]


@pytest.mark.parametrize(
    "middle", ["--then", "--then --then", "--go-to 0 0 0", "--release cup", "--grasp cup"]
)
def test_settings_of_an_object_are_separated(middle: str) -> None:
    """A drawer behind a door is opened in a step of its own."""
    found = parse_steps(f"--set case.hinge=2.2 {middle} --set case.slide=0.3")
    settings = [one for one in found if one["step"] == "Actuate"]
    door, drawer = vkc.Actuate("case", {"hinge": 2.2}), vkc.Actuate("case", {"slide": 0.3})
    assert settings == list_data(door, drawer)
    joined = vkc.Actuate("case", {"hinge": 2.2, "slide": 0.3})
    assert parse_steps("--then --set case.hinge=2.2 --set case.slide=0.3") == list_data(joined)


def test_steps_of_all_kinds_keep_their_order() -> None:
    pose = " ".join(map(str, POSE))
    words = "--grasp cup.rim --go-to 1 0 -0.5 --place cup 1 2 0.8 --grasp stick --touch stick.tip"
    words += f" 0.5 -0.1 1 --place stick {pose} --release stick --reach {pose} --set door.hinge=1"
    assert parse_steps(words) == list_data(
        vkc.Grasp("cup", "rim"),
        vkc.GoTo(1.0, 0.0, -0.5),
        vkc.Place("cup", (1.0, 2.0, 0.8)),
        vkc.Grasp("stick"),
        vkc.Touch("stick.tip", (0.5, -0.1, 1.0)),
        vkc.Place("stick", POSE),
        vkc.Release("stick"),
        vkc.Reach(POSE),
        vkc.Actuate("door", {"hinge": 1.0}),
    )


def test_joints_of_the_robot_are_set_together() -> None:
    words = "--joint elbow=1 --joint base_x=-0.5 --then --joint elbow=2 --joint elbow=3"
    assert parse_steps(words) == list_data(
        vkc.Configure({"elbow": 1.0, "base_x": -0.5}),
        vkc.Configure({"elbow": 2.0}),
        vkc.Configure({"elbow": 3.0}),
    )
    for wrong, problem in (("elbow", "not a setting"), ("elbow=far", "not a number after '='")):
        with expect_error(problem, field="--joint"):
            parse_steps(f"--joint {wrong}")


def test_a_joint_goal_is_planned_from_the_command_line(run: RunCommand) -> None:
    result = run("plan drawer --joint elbow_joint=1 --save plan.npz --quiet")
    assert result.code == 0, result.err
    assert vkc.Plan.load("plan.npz").steps == (vkc.Configure({"elbow_joint": 1.0}),)
    result = run("plan drawer --joint elbow=1")
    assert result.code == 2
    assert "did you mean 'elbow_joint'" in result.err


def test_an_object_is_grasped_from_the_command_line(run: RunCommand) -> None:
    result = run("plan init_1 --grasp stick.grip --save stick.npz --quiet")
    assert result.code == 0, result.err
    plan = vkc.Plan.load("stick.npz")
    assert list_data(*plan.steps) == list_data(vkc.Grasp("stick", "grip"))
    assert plan.end_scene().held == {"stick": "grip"}


def test_another_robot_plans_in_the_scene(run: RunCommand, tmp_path: Path) -> None:
    (tmp_path / "tall.yaml").write_text(f"urdf: {vkc.load_robot('husky_ur5e').urdf}\n")
    result = run("plan drawer --robot tall.yaml --go-to 0 0 0 --save tall.npz --quiet")
    assert result.code == 0, result.err
    plan = vkc.Plan.load("tall.npz")
    assert (plan.scene.robot.name, plan.scene.robot.base) == ("tall", "omni")
    result = run("plan drawer --robot husky --go-to 0 0 0")
    assert result.code == 2
    assert "did you mean" in result.err
