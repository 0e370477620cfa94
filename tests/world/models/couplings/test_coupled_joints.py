"""Tests the search for coupled joints and their validation."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.telescopes import format_joint, format_link, write_telescope

import vkc_pin as vkc
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.world.files.urdf import read_urdf
from vkc_pin.world.models.couplings import JointCoupling, find_followers


def write_chain(tmp_path: Path, *contents: str, kinds: str = "prismatic") -> Path:
    """Write a chain of joints j1, j2, ... with given contents, and shapes on every other link."""
    parts = [format_link("root", "0.1 0.1 0.1")]
    for k, text in enumerate(contents, start=1):
        parts += [
            format_link(f"l{k}", "0.1 0.1 0.1" if k % 2 else ""),
            format_joint(f"j{k}", kinds, f"l{k - 1}" if k > 1 else "root", f"l{k}", inside=text),
        ]
    path = tmp_path / "robot.urdf"
    path.write_text(f'<robot name="robot">{"".join(parts)}</robot>', encoding="utf-8")
    return path


def format_mimic(leader: str, multiplier: float = 1.0, offset: float = 0.0) -> str:
    return f'<mimic joint="{leader}" multiplier="{multiplier}" offset="{offset}"/>'


def test_chains_are_resolved_to_their_leader(tmp_path: Path) -> None:
    """j3 = -0.5·j2 + 0.2 and j2 = 2·j1 + 0.1, in any order of the file."""
    found = find_followers(
        read_urdf(
            write_chain(tmp_path, "", format_mimic("j1", 2.0, 0.1), format_mimic("j2", -0.5, 0.2))
        ).root
    )
    assert found.keys() == {"j2", "j3"}
    assert found["j2"] == JointCoupling("j1", 2.0, 0.1)
    assert (found["j3"].leader, found["j3"].factor, found["j3"].offset) == (
        "j1",
        -1.0,
        pytest.approx(0.15),
    )


def test_a_leader_below_its_follower_becomes_a_follower(tmp_path: Path) -> None:
    """j1 = 2·j3 + 0.1 makes j3 = 0.5·j1 - 0.05, and j2 = -4·j3 makes j2 = -2·j1 + 0.2."""
    found = find_followers(
        read_urdf(
            write_chain(tmp_path, format_mimic("j3", 2.0, 0.1), format_mimic("j3", -4.0), "")
        ).root
    )
    assert found == {"j3": JointCoupling("j1", 0.5, -0.05), "j2": JointCoupling("j1", -2.0, 0.2)}


@pytest.mark.parametrize(
    ("contents", "message"),
    [
        (("", format_mimic("j3"), format_mimic("j2")), "j2: couplings are circular.* j2 → j3 → j2"),
        (("", format_mimic("j2")), "j2: couplings are circular.* j2 → j2"),
        (
            ("", format_mimic("other")),
            "j2: .*follows one that cannot move.*'other', which does not exist",
        ),
        (
            ("", format_mimic("j3"), format_mimic("still")),
            "j2: .*follows one that cannot move.*'still', which is fixed",
        ),
    ],
)
@pytest.mark.filterwarnings("ignore:.*there is no joint")
def test_leaders_that_cannot_move_raise(
    tmp_path: Path, contents: tuple[str, ...], message: str
) -> None:
    path = write_chain(tmp_path, *contents)
    fixed = format_link("aside") + format_joint("still", "fixed", "root", "aside")
    path.write_text(path.read_text().replace("</robot>", fixed + "</robot>"))
    with pytest.raises(InputError, match=message) as caught:
        vkc.load_robot(path, pairs="all", tool_frame=f"l{len(contents)}")
    assert (caught.value.file, caught.value.line) == (path, 1)


def test_invalid_couplings_off_the_tool_path_are_ignored(tmp_path: Path) -> None:
    """The fingers of published robots have such couplings."""
    path = write_chain(tmp_path, "", "", format_mimic("other"))
    with pytest.warns(UserWarning, match="there is no joint 'other'"):
        robot = vkc.load_robot(path, pairs="all", tool_frame="l2")
    assert robot.coordinates.names[3:] == ("j1", "j2")


def test_couplings_of_robot_yaml_override_the_urdf(tmp_path: Path) -> None:
    """Both the short and the full form are read."""
    write_chain(tmp_path, "", format_mimic("j1", 3.0), "")
    text = (
        "urdf: robot.urdf\ntool_frame: l3\ncouplings:\n  j2: j1\n"
        "  j3: {joint: j2, multiplier: -2.0, offset: 0.5}\n"
    )
    (tmp_path / "robot.yaml").write_text(text)
    found = find_followers(vkc.load_robot(tmp_path, pairs="all").file.root)
    assert found == {"j2": JointCoupling("j1", 1.0, 0.0), "j3": JointCoupling("j1", -2.0, 0.5)}


@pytest.mark.parametrize(
    ("couplings", "field", "message"),
    [
        ("out_2: out1", "out_2", "no joint that turns or slides 'out1'; did you mean 'out_1'"),
        ("oat_2: out_1", "oat_2", "no joint that turns or slides 'oat_2'; did you mean 'out_2'"),
        ("out_2: out_3, out_3: out_2", "out_2", "circular"),
        (
            "out_2: {joint: out_1, multiplier: 0}",
            "out_2.multiplier",
            "multiplier must not be 0",
        ),
        ("out_2: {joint: out_1, multiplier: yes}", "out_2.multiplier", "a number"),
        ("out_2: {joint: out_1, factor: 2}", "out_2.factor", "multiplier"),
        ("out_2: {multiplier: 2}", "out_2.joint", "missing"),
        ("out_2: 3", "out_2", "."),
    ],
)
def test_invalid_couplings_raise(tmp_path: Path, couplings: str, field: str, message: str) -> None:
    path = write_telescope(tmp_path, couplings=couplings)
    with pytest.raises((InputError, UnknownNameError), match=message) as caught:
        vkc.load_robot(path)
    assert (caught.value.file, caught.value.line) == (path, 5)
    assert caught.value.field == f"couplings.{field}"


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (
            "locked_joints: {out_3: 0.0}",
            "locked_joints.out_3: .* follows one that is not locked.*'out_1' is not locked",
        ),
        (
            "home: {out_1: 0.1, out_3: 0.0}",
            "home.out_3: this joint follows 'out_1'.*0.1, or no value.*got 0",
        ),
        ("home: {out_1: 0.2}", "home.out_1: .*outside the joint.s limits"),
    ],
)
def test_rest_positions_must_respect_couplings(tmp_path: Path, more: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        vkc.load_robot(write_telescope(tmp_path, more=more))


def test_locking_a_leader_locks_its_followers(tmp_path: Path) -> None:
    robot = vkc.load_robot(write_telescope(tmp_path, more="locked_joints: {out_1: 0.1}\n"))
    assert robot.coordinates.names[3:] == ("lift", "yaw_joint", "pitch_joint", "roll_joint")
    free = vkc.load_robot(
        write_telescope(tmp_path / "free", more="home: {out_1: 0.1, out_2: 0.1}\n")
    )
    tool = [one.model.frames[one.model.getFrameId("tool")] for one in (robot, free)]
    assert tool[0].placement.isApprox(tool[1].placement, 1e-12)
    assert robot.model.jointPlacements[3].translation[0] == pytest.approx(
        4 * 0.1 + 0.05 + 3 * 0.005 + 0.24
    )
