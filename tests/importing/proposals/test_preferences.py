from __future__ import annotations

from pathlib import Path

import pytest
from helpers.texts import format_box

import vkc_pin as vkc


def write_drawer(folder: Path, *pieces: tuple[str, str, str], walls: str = "") -> Path:
    """Write a drawer that slides along -x, with pieces (name, place, size) on its front."""
    shapes = format_box("0.02 0.5 0.3", "0.01 0 0")
    shapes += "".join(format_box(size, at, name=name) for name, at, size in pieces)
    case = format_box("0.5 0.5 0.5", "0.3 0 0") + walls
    (folder / "d.urdf").write_text(f"""<robot name="d"><link name="case">{case}</link>
      <link name="tray">{shapes}</link><joint name="slide" type="prismatic">
      <parent link="case"/><child link="tray"/><axis xyz="-1 0 0"/>
      <limit lower="0" upper="0.3" effort="1" velocity="1"/></joint></robot>""")
    return folder / "d.urdf"


BAR = [
    ("bar", "-0.06 0.19 0.14", "0.015 0.11 0.015"),
    ("post_1", "-0.03 0.24 0.14", "0.06 0.012 0.012"),
    ("post_2", "-0.03 0.14 0.14", "0.06 0.012 0.012"),
]


@pytest.mark.parametrize(
    "knob",
    [
        ("knob", "-0.02 0 0", "0.04 0.004 0.004"),
        ("knob", "-0.02 0 -0.02", "0.04 0.003 0.03"),
        ("handle", "-0.03 0 0.02", "0.06 0.004 0.004"),
        ("pull_screw", "-0.02 0 0", "0.04 0.003 0.003"),
        ("lever", "-0.02 0.02 0", "0.04 0.002 0.01"),
    ],
)
def test_bar_is_preferred_to_a_thin_knob(tmp_path: Path, knob: tuple[str, str, str]) -> None:
    """The bar is off the centre, and its name does not suggest a handle."""
    file = write_drawer(tmp_path, *BAR, knob)
    (found,) = vkc.importing.import_object(file, tmp_path / "out", most=1).proposals.found
    assert found.thickness > 0.01


@pytest.mark.parametrize("hidden", [True, False])
def test_reachable_bar_is_preferred_to_a_hidden_knob(tmp_path: Path, hidden: bool) -> None:
    """A board behind the knob obstructs the hand there, but not at the bar."""
    knob = ("knob", "-0.025 0 -0.05", "0.05 0.03 0.03")
    board = format_box("0.2 0.5 0.02", "-0.7 0 -0.05") if hidden else ""
    file = write_drawer(tmp_path, *BAR, knob, walls=board)
    best = vkc.importing.import_object(file, tmp_path / "out").proposals.found[0]
    assert best.named is not hidden
    assert best.opens == {"slide": pytest.approx(0.3)}


@pytest.mark.parametrize(("gap", "goal"), [(0.3, 0.225), (0.34, 0.2625), (0.6, 0.3)])
def test_report_states_the_reachable_opening_of_a_joint(
    tmp_path: Path, gap: float, goal: float
) -> None:
    """A wall in front of the drawer stops the hand before the joint's limit."""
    wall = format_box("0.1 0.6 0.5", f"{-gap - 0.05} 0 0")
    file = write_drawer(tmp_path, *BAR, walls=wall)
    imported = vkc.importing.import_object(file, tmp_path / "out", most=1)
    assert imported.proposals.find_goal("slide") == pytest.approx(goal)
    text = f": a hand opens it to {goal:.3g} m, {goal / 0.3:.0%} of its range"
    assert (text in imported.summary()) is (goal < 0.3)
