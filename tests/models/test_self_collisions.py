from __future__ import annotations

from pathlib import Path

import pytest

from vkc_pin.files import resources
from vkc_pin.files.srdf import read_srdf
from vkc_pin.models.robot import Robot
from vkc_pin.models.robot_file import load_robot
from vkc_pin.models.self_collisions import sample_allowed_pairs, write_srdf

SRDF = resources.folder("robots") / "husky_ur5e" / "husky_ur5e.srdf"


@pytest.fixture(scope="module")
def husky() -> Robot:
    return load_robot("husky_ur5e")


def test_committed_list_is_what_sampling_finds(husky: Robot) -> None:
    assert sample_allowed_pairs(husky, samples=3000, seed=7) == read_srdf(SRDF, links=husky.file.links).allowed


def test_same_seed_same_pairs(husky: Robot) -> None:
    assert sample_allowed_pairs(husky, samples=100, seed=3) == sample_allowed_pairs(husky, samples=100, seed=3)


def test_reasons(husky: Robot) -> None:
    allowed = read_srdf(SRDF, links=husky.file.links).allowed
    assert allowed["shoulder_link", "upper_arm_link"] == "Adjacent"
    assert allowed["gripper_link", "wrist_2_link"] == "Never"
    assert ("base_link", "forearm_link") not in allowed
    assert "Always" not in allowed.values()


def test_always_and_never(tmp_path: Path) -> None:
    links = "".join(
        f'<link name="{name}"><collision><geometry><sphere radius="{radius}"/></geometry></collision></link>'
        for name, radius in (("foot", 1.0), ("middle", 0.1), ("inner", 0.2), ("outer", 0.1))
    )
    joints = "".join(
        f'<joint name="{child}_joint" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{x} 0 0"/><axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>'
        for parent, child, x in (("foot", "middle", 0.3), ("middle", "inner", 0.2), ("inner", "outer", 4.0))
    )
    (tmp_path / "odd.urdf").write_text(f'<robot name="odd">{links}{joints}</robot>')
    robot = load_robot(tmp_path / "odd.urdf", pairs="all")
    assert sample_allowed_pairs(robot, samples=50) == {
        ("foot", "inner"): "Always",
        ("foot", "middle"): "Adjacent",
        ("foot", "outer"): "Never",
        ("inner", "middle"): "Adjacent",
        ("inner", "outer"): "Adjacent",
        ("middle", "outer"): "Never",
    }


def test_written_file_reads_back(husky: Robot, tmp_path: Path) -> None:
    file = write_srdf(husky, tmp_path / "new.srdf", samples=50)
    again = read_srdf(file, links=husky.file.links)
    assert again.allowed == sample_allowed_pairs(husky, samples=50)
    assert list(again.state(husky.coordinates.names[3:]).values()) == pytest.approx(list(husky.home))
    assert [path.name for path in tmp_path.iterdir()] == ["new.srdf"]
    assert load_robot("husky_ur5e", srdf=file).home == pytest.approx(husky.home)
