from __future__ import annotations

from pathlib import Path

import pytest
from helpers.arm_urdf import write_arms

import vkc_pin as vkc
from vkc_pin.importing.robots.sources import Source, read_source
from vkc_pin.world.files import resources


def read(file: Path, scratch: Path) -> Source:
    return read_source(file, scratch, packages={}, arguments={})


def test_what_a_urdf_does_not_have_is_left_out_and_what_is_missing_is_told(tmp_path: Path) -> None:
    path = write_arms(tmp_path)
    text = path.read_text(encoding="utf-8").replace(' effort="10"', "", 1)
    path.write_text(
        text.replace("</robot>", "<gazebo/><transmission name='t'/></robot>"), encoding="utf-8"
    )
    source = read(path, tmp_path)
    assert source.kind == "URDF"
    assert "left out elements that a URDF does not have: <gazebo>, <transmission>" in source.notes
    assert any("state no effort or velocity limit: arm_1_joint" in note for note in source.notes)
    assert source.file.root.find("gazebo") is None


def test_groups_and_states_come_from_the_srdf_beside(tmp_path: Path) -> None:
    folder = resources.find_example_robot_data()
    assert folder is not None
    source = read(folder / "robots" / "panda_description" / "urdf" / "panda.urdf", tmp_path)
    assert source.groups["panda_arm" if "panda_arm" in source.groups else "arm"][:1]
    assert source.srdf.states
    assert source.srdf.allowed


def test_an_srdf_of_another_robot_is_named(tmp_path: Path) -> None:
    path = write_arms(tmp_path)
    other = "<robot name='x'><disable_collisions link1='elsewhere' link2='body'/></robot>"
    (tmp_path / "robot.srdf").write_text(other, encoding="utf-8")
    source = read(path, tmp_path)
    assert any("links of another robot" in note for note in source.notes)
    with pytest.raises(vkc.UnknownNameError):
        read_source(path, tmp_path, packages={}, arguments={}, srdf=tmp_path / "robot.srdf")
