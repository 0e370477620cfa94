from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.arm_urdf import write_arms
from helpers.commands import RunCommand
from helpers.grippers import write_gripper
from helpers.homes import HOME_MJCF
from helpers.partnet import SDF
from helpers.robots import compute_placement

import vkc_pin as vkc


def check_force(run: RunCommand, command: str) -> None:
    """Check that a repeated import asks for --force."""
    result = run(command)
    assert result.code == 2
    assert "--force" in result.err


def test_robot_is_imported_and_examined(tmp_path: Path, run: RunCommand) -> None:
    write_arms(Path("given"), sides=("left_", "right_"))
    command = "import-robot given/robot.urdf --output mine --arm left --samples 100"
    result = run(command)
    assert result.code == 0
    assert "arm: left, 5 joints, 2 fingers" in result.out
    assert "wrote mine" in result.out
    check_force(run, command)
    assert "mine: 0 faults" in run("doctor mine").out
    result = run("doctor mine --margin 0.6")
    assert result.code == 1
    assert "the margin is 600 mm" in result.out
    for source in ("mine", "mine/scene.yaml", "mine/mine.urdf"):
        assert run(f"view {source} --html page.html").code == 0
        assert "mine" in Path("page.html").read_text(encoding="utf-8")
    assert run("check mine/scene.yaml").code == 0
    robot = vkc.load_robot(Path("mine"))
    assert robot.coordinates.names[3] == "left_arm_1_joint"
    tool = compute_placement(robot, "tool", np.r_[0.5, 0.2, 0.0, robot.home])
    pose = " ".join(map(str, [*tool.translation, *pin.rpy.matrixToRpy(tool.rotation)]))
    steps = f"--go-to 0.5 -0.2 0.3 --reach {pose} --go-to 1 0 0"
    assert run(f"plan {tmp_path}/mine/scene.yaml {steps} --quiet --save plan.npz").code == 0
    plan = vkc.Plan.load("plan.npz")
    assert [type(step) for step in plan.steps] == [vkc.GoTo, vkc.Reach, vkc.GoTo]
    assert plan.trajectory.positions[-1, :3] == pytest.approx([1.0, 0.0, 0.0], abs=1e-3)


@pytest.mark.parametrize(
    ("command", "part"),
    [
        ("import-robot none.urdf", "cannot read the URDF, xacro, MJCF, SDF, USD or MoveIt .scene"),
        ("import-robot given/robot.urdf --output given", "got other files"),
        ("import-robot given/robot.urdf --package meshes", "NAME=FOLDER"),
        ("import-home none.xml", "none.xml"),
        (
            "import-home binary.urdf",
            "expected a URDF, xacro, MJCF, SDF, USD or MoveIt .scene file in UTF-8, got",
        ),
        ("check drawer --plot it.xyz", "--plot: not the name of a picture (expected a name"),
        ("doctor husky_ur5", "did you mean 'husky_ur5e'?"),
    ],
)
def test_misuse_is_explained_in_one_line(
    command: str, part: str, tmp_path: Path, run: RunCommand
) -> None:
    write_arms(Path("given"))
    Path("binary.urdf").write_bytes(b"<robot>\xff")
    result = run(command)
    assert (result.code, result.out) == (2, "")
    assert part in result.err
    assert len(result.err.splitlines()) == 1
    assert {file.name for file in tmp_path.iterdir()} == {"given", "binary.urdf"}


def test_object_is_imported(tmp_path: Path, run: RunCommand) -> None:
    Path("box.sdf").write_text(SDF)
    command = "import-object box.sdf --output out --height 0.7 --most 1"
    result = run(command)
    assert result.code == 0
    assert "0.70 m" in result.out
    assert "door_bar (bar, named as a handle)" in result.out
    assert result.out.count("wrote") == 3
    written = {"attachments.png", "box.urdf", "box.yaml", "scene.yaml", ".vkc-pin.json"}
    assert {file.name for file in Path("out").iterdir()} == written
    check_force(run, command)
    assert "0.80 m" in run(command.replace("0.7", "0.8") + " --force").out
    assert "door_bar" in run("check out/scene.yaml").out
    scene = vkc.load_scene(tmp_path / "out/scene.yaml")
    plan = vkc.plan(scene, [vkc.Actuate("box", {"hinge": -0.5})])
    assert plan.success, plan.summary()
    assert run("view out/box.yaml --html page.html").code == 0


def test_robot_folder_takes_precedence_over_known_names(tmp_path: Path, run: RunCommand) -> None:
    """An imported Panda replaces that of example-robot-data, whose hand is undefined."""
    Path("box.sdf").write_text(SDF)
    command = "import-object box.sdf --robot panda --most 1"
    result = run(command)
    assert result.code == 2
    assert "panda.urdf: touch_links: the hand of 'panda' is undefined" in result.err
    assert "import-robot" in result.err
    write_gripper(Path("panda"))
    assert "for the hand of panda, best first" in run(command).out
    assert "panda_joint1" not in run("doctor panda").out
    fixed = f"import-object box.sdf --robot {tmp_path}/panda --most 1 --output fixed"
    assert run(fixed).code == 0
    Path("moved").mkdir()
    for folder in ("box", "panda", "fixed"):
        Path(folder).rename(f"moved/{folder}")
    robot = vkc.load_scene("moved/box/scene.yaml").robot
    assert robot.urdf.resolve().parent == tmp_path / "moved" / "panda"
    with pytest.raises(vkc.InputError, match=f"{tmp_path}/panda"):
        vkc.load_scene("moved/fixed/scene.yaml")


def test_home_is_imported_as_a_scene(run: RunCommand) -> None:
    pytest.importorskip("mujoco")
    Path("small.xml").write_text(HOME_MJCF)
    command = "import-home small.xml --output out --most 1 --seed 3"
    result = run(command)
    assert result.code == 0
    assert "5 obstacles, 1 articulated objects, 1 free objects" in result.out
    assert result.out.endswith("wrote out/scene.yaml\n")
    check_force(run, command)
    assert run("check out/scene.yaml").code == 0
