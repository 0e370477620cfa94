from __future__ import annotations

from pathlib import Path

import pytest
from helpers.arm_urdf import write_arms
from helpers.downloads import SDF
from helpers.grippers import write_gripper
from helpers.homes import HOME_MJCF

import vkc_pin as vkc
from vkc_pin.cli import commands
from vkc_pin.cli.importing import EXIT_SICK


def test_a_robot_is_imported_and_examined(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, folder = write_arms(tmp_path / "given", sides=("left_", "right_")), tmp_path / "mine"
    assert (
        commands.run(
            [
                "import-robot",
                str(file),
                "--output",
                str(folder),
                "--arm",
                "left",
                "--samples",
                "100",
            ]
        )
        == 0
    )
    said = capsys.readouterr()
    assert "arm: left, 5 joints, 2 fingers" in said.out
    assert f"wrote {folder}" in said.out
    assert vkc.load_robot(folder).coordinates.names[3] == "left_arm_1_joint"
    again = ["import-robot", str(file), "--output", str(folder), "--samples", "100"]
    assert commands.run(again) == commands.EXIT_MISUSE
    assert "--force" in capsys.readouterr().err
    assert commands.run(["doctor", str(folder)]) == 0
    assert "mine: 0 faults" in capsys.readouterr().out
    assert commands.run(["doctor", str(folder), "--margin", "0.6"]) == EXIT_SICK
    assert "the margin is 600 mm" in capsys.readouterr().out


def test_what_is_wrong_is_said_on_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = write_arms(tmp_path / "given")
    (tmp_path / "binary").write_bytes(b"<robot>\xff")
    for arguments, part in (
        (["import-robot", str(tmp_path / "none.urdf")], "cannot read the robot"),
        (["import-robot", str(file), "--output", str(tmp_path / "given")], "got other files"),
        (
            ["import-robot", str(file), "--output", str(tmp_path / "new"), "--package", "meshes"],
            "NAME=FOLDER",
        ),
        (
            ["import-home", str(tmp_path / "binary")],
            "cannot read the URDF or MJCF (expected a URDF or MJCF file in UTF-8, got",
        ),
        (
            ["check", "drawer", "--plot", str(tmp_path / "it.xyz")],
            "--plot: not the name of a picture (expected a name that ends",
        ),
        (["doctor", "husky_ur5"], "did you mean 'husky_ur5e'?"),
    ):
        assert commands.run(arguments) == commands.EXIT_MISUSE
        said = capsys.readouterr()
        assert part in said.err
        assert said.out == ""
        assert len(said.err.splitlines()) == 1
    assert not (tmp_path / "new").exists()


def test_import_object_writes_and_reports(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "box.sdf").write_text(SDF)
    box, folder = str(tmp_path / "box.sdf"), str(tmp_path / "out")
    assert (
        commands.run(["import-object", box, "--output", folder, "--height", "0.7", "--most", "1"])
        == 0
    )
    said = capsys.readouterr().out
    assert "0.70 m" in said
    assert "door_bar (bar, called a handle)" in said
    assert said.count("wrote") == 2
    names = ["attachments.png", "box.urdf", "box.yaml"]
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == [".vkc-pin.json", *names]
    assert (
        commands.run(
            ["import-object", str(tmp_path / "box.sdf"), "--output", str(tmp_path / "out")]
        )
        == commands.EXIT_MISUSE
    )
    assert "--force" in capsys.readouterr().err
    assert (
        commands.run(
            ["import-object", box, "--output", folder, "--height", "0.8", "--most", "1", "--force"]
        )
        == 0
    )
    assert "0.80 m" in capsys.readouterr().out


def test_a_folder_here_comes_before_a_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who has imported a Panda means that one, not the file of example-robot-data, which says nothing of its hand."""
    (tmp_path / "box.sdf").write_text(SDF)
    monkeypatch.chdir(tmp_path)
    command = ["import-object", "box.sdf", "--robot", "panda", "--most", "1"]
    assert commands.run(command) == commands.EXIT_MISUSE
    said = capsys.readouterr().err
    assert "panda.urdf: touch_links: the hand of 'panda' is undefined" in said
    assert "import-robot" in said
    write_gripper(tmp_path / "panda")
    assert commands.run(command) == 0
    assert "for the hand of panda, best first" in capsys.readouterr().out
    assert commands.run(["doctor", "panda"]) == 0
    assert "panda_joint1" not in capsys.readouterr().out


def test_import_home_writes_a_scene_and_reports(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mujoco")
    (tmp_path / "small.xml").write_text(HOME_MJCF)
    command = [
        "import-home",
        str(tmp_path / "small.xml"),
        "--output",
        str(tmp_path / "out"),
        "--most",
        "1",
        "--seed",
        "3",
    ]
    assert commands.run(command) == 0
    said = capsys.readouterr().out
    assert "5 obstacles, 1 articulated objects, 1 free objects" in said
    assert said.endswith(f"wrote {tmp_path / 'out' / 'scene.yaml'}\n")
    assert commands.run(command) == commands.EXIT_MISUSE
    assert "--force" in capsys.readouterr().err
    assert commands.run([*command, "--force"]) == 0
    assert commands.run(["check", str(tmp_path / "out" / "scene.yaml")]) == 0
    assert commands.run(["import-home", str(tmp_path / "none.xml")]) == commands.EXIT_MISUSE
    assert "none.xml" in capsys.readouterr().err
