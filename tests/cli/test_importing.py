from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.arm_urdf import write_arms
from helpers.grippers import write_gripper
from helpers.homes import HOME_MJCF
from helpers.partnet import SDF

import vkc_pin as vkc
from vkc_pin.cli import commands


def run_command(command: str) -> int:
    return commands.run(command.split())


def test_robot_is_imported_and_examined(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    file = write_arms(tmp_path / "given", sides=("left_", "right_"))
    command = f"import-robot {file} --output mine --arm left --samples 100"
    assert run_command(command) == 0
    output = capsys.readouterr().out
    assert "arm: left, 5 joints, 2 fingers" in output
    assert "wrote mine" in output
    assert vkc.load_robot(tmp_path / "mine").coordinates.names[3] == "left_arm_1_joint"
    assert run_command(command) == commands.EXIT_MISUSE
    assert "--force" in capsys.readouterr().err
    assert run_command("doctor mine") == 0
    assert "mine: 0 faults" in capsys.readouterr().out
    assert run_command("doctor mine --margin 0.6") == 1
    assert "the margin is 600 mm" in capsys.readouterr().out
    for source in ("mine", "mine/scene.yaml", "mine/mine.urdf"):
        assert run_command(f"view {source} --html page.html") == 0
        assert "mine" in Path("page.html").read_text(encoding="utf-8")
    assert run_command("check mine/scene.yaml") == 0
    robot = vkc.load_robot(tmp_path / "mine")
    data, q = robot.model.createData(), robot.coordinates.q(np.r_[0.5, 0.2, 0.0, robot.home])
    pin.framesForwardKinematics(robot.model, data, q)
    tool = data.oMf[robot.model.getFrameId("tool")]
    pose = " ".join(map(str, [*tool.translation, *pin.rpy.matrixToRpy(tool.rotation)]))
    steps = f"--go-to 0.5 -0.2 0.3 --reach {pose} --go-to 1 0 0"
    assert run_command(f"plan {tmp_path}/mine/scene.yaml {steps} --quiet --save plan.npz") == 0
    plan = vkc.Plan.load("plan.npz")
    assert [type(step) for step in plan.steps] == [vkc.GoTo, vkc.Reach, vkc.GoTo]
    assert plan.trajectory.positions[-1, :3] == pytest.approx([1.0, 0.0, 0.0], abs=1e-3)


def test_misuse_is_explained_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    file = write_arms(tmp_path / "given")
    (tmp_path / "binary.urdf").write_bytes(b"<robot>\xff")
    for command, part in (
        ("import-robot none.urdf", "cannot read the robot"),
        (f"import-robot {file} --output given", "got other files"),
        (f"import-robot {file} --output new --package meshes", "NAME=FOLDER"),
        ("import-home none.xml", "none.xml"),
        ("import-home binary.urdf", "expected a URDF, xacro, MJCF or SDF file in UTF-8, got"),
        ("check drawer --plot it.xyz", "--plot: not the name of a picture (expected a name"),
        ("doctor husky_ur5", "did you mean 'husky_ur5e'?"),
    ):
        assert run_command(command) == commands.EXIT_MISUSE
        printed = capsys.readouterr()
        assert part in printed.err
        assert printed.out == ""
        assert len(printed.err.splitlines()) == 1
    assert not (tmp_path / "new").exists()


def test_object_is_imported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "box.sdf").write_text(SDF)
    command = "import-object box.sdf --output out --height 0.7 --most 1"
    assert run_command(command) == 0
    output = capsys.readouterr().out
    assert "0.70 m" in output
    assert "door_bar (bar, named as a handle)" in output
    assert output.count("wrote") == 3
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == [
        ".vkc-pin.json",
        "attachments.png",
        "box.urdf",
        "box.yaml",
        "scene.yaml",
    ]
    assert run_command(command) == commands.EXIT_MISUSE
    assert "--force" in capsys.readouterr().err
    assert run_command(command.replace("0.7", "0.8") + " --force") == 0
    assert "0.80 m" in capsys.readouterr().out
    scene = vkc.load_scene(tmp_path / "out" / "scene.yaml")
    assert run_command("check out/scene.yaml") == 0
    assert "door_bar" in capsys.readouterr().out
    plan = vkc.plan(scene, [vkc.Actuate("box", {"hinge": -0.5})])
    assert plan.success, plan.summary()
    assert run_command("view out/box.yaml --html page.html") == 0


def test_robot_folder_takes_precedence_over_known_names(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """An imported Panda replaces that of example-robot-data, whose hand is undefined."""
    (tmp_path / "box.sdf").write_text(SDF)
    monkeypatch.chdir(tmp_path)
    command = "import-object box.sdf --robot panda --most 1"
    assert run_command(command) == commands.EXIT_MISUSE
    error = capsys.readouterr().err
    assert "panda.urdf: touch_links: the hand of 'panda' is undefined" in error
    assert "import-robot" in error
    write_gripper(tmp_path / "panda")
    assert run_command(command) == 0
    assert "for the hand of panda, best first" in capsys.readouterr().out
    assert run_command("doctor panda") == 0
    assert "panda_joint1" not in capsys.readouterr().out
    assert (
        run_command(f"import-object box.sdf --robot {tmp_path}/panda --most 1 --output fixed") == 0
    )
    for folder in ("box", "panda", "fixed"):
        (tmp_path / "moved" / folder).parent.mkdir(exist_ok=True)
        (tmp_path / folder).rename(tmp_path / "moved" / folder)
    robot = vkc.load_scene("moved/box/scene.yaml").robot
    assert robot.urdf.resolve().parent == tmp_path / "moved" / "panda"
    with pytest.raises(vkc.InputError, match=f"{tmp_path}/panda"):
        vkc.load_scene("moved/fixed/scene.yaml")


def test_home_is_imported_as_a_scene(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "small.xml").write_text(HOME_MJCF)
    command = "import-home small.xml --output out --most 1 --seed 3"
    assert run_command(command) == 0
    output = capsys.readouterr().out
    assert "5 obstacles, 1 articulated objects, 1 free objects" in output
    assert output.endswith("wrote out/scene.yaml\n")
    assert run_command(command) == commands.EXIT_MISUSE
    assert "--force" in capsys.readouterr().err
    assert run_command("check out/scene.yaml") == 0
