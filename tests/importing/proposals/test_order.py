"""Tests that joints can be opened in the order that proposals state."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np
import pytest
from helpers.texts import format_box

import vkc_pin as vkc
from vkc_pin.cli import main

LIMIT = '<limit lower="0" upper="{}" effort="9" velocity="1"/>'
BODY = f'<link name="body">{format_box("0.3 0.6 0.8", "0 0 0.4")}</link>'


def format_joint(
    name: str, kind: str, child: str, at: str, axis: str, upper: float = 2.0, parent: str = "body"
) -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    head = f'<joint name="{name}" type="{kind}">{ends}<origin xyz="{at}"/>'
    return f'{head}<axis xyz="{axis}"/>{LIMIT.format(upper)}</joint>'


def format_leaves(kind: str = "revolute", *, right: str = "", right_upper: float = 2.0) -> str:
    """Format a cupboard with two leaves whose handles are 40 mm apart.

    Args:
        kind: "revolute" for doors close to the body, "prismatic" for thick shutters that slide up
            with room for a hand below and behind them.
        right: Further shapes of the right leaf.
        right_upper: Upper limit of the right leaf.
    """
    thick, x, z = ("0.02", 0.165, 0.45) if kind == "revolute" else ("0.1", 0.4, 1.1)
    handle_x = 0.04 + float(thick) / 2.0
    axes = ("0 0 -1", "0 0 1") if kind == "revolute" else ("0 0 1", "0 0 1")
    upper = 2.0 if kind == "revolute" else 0.2
    parts = [BODY]
    for name, side, axis, more in (("left", 1.0, axes[0], ""), ("right", -1.0, axes[1], right)):
        leaf = format_box(f"{thick} 0.288 0.6", f"0 {side * 0.145} 0")
        handle = format_box("0.02 0.02 0.1", f"{handle_x} {side * 0.27} 0")
        end = min(upper, right_upper) if name == "right" else upper
        parts += [
            f'<link name="{name}">{leaf}{handle}{more}</link>',
            format_joint(f"{name}_joint", kind, name, f"{x} {-side * 0.29} {z}", axis, end),
        ]
    return f'<robot name="cupboard">{"".join(parts)}</robot>'


KNOB = format_box("0.02 0.02 0.1", "0.05 -0.15 0.2", name="knob")  # beside the right handle


def propose(text: str, folder: Path) -> vkc.importing.Proposals:
    (folder / "t.urdf").write_text(text)
    item = vkc.load_object({"urdf": "t.urdf", "attachments": []}, folder=folder)
    return vkc.importing.propose_attachments(item)


def find_openable(found: vkc.importing.Proposals) -> dict[str, float]:
    """Return how far hands open joints that begin closed, by grasps whose conditions hold."""
    opened = dict[str, float]()
    while True:
        before = dict(opened)
        for proposal in found.found:
            is_met = all(
                abs(value) <= abs(opened.get(joint, 0.0)) + 1e-9
                for joint, value in proposal.when.items()
            )
            for joint, value in proposal.opens.items():
                if is_met and abs(value) > abs(opened.get(joint, 0.0)):
                    opened[joint] = value
        if opened == before:
            return opened


def assert_openable(found: vkc.importing.Proposals) -> None:
    """Assert that every proposed joint can be opened, and each other joint has a reason."""
    opened = find_openable(found)
    assert set(opened) | set(found.because) == set(found.object.coordinates.names)
    assert not set(opened) & set(found.because)
    for joint, value in opened.items():
        assert found.find_goal(joint) == pytest.approx(value)


def test_doors_that_each_need_the_other_open_are_in_a_circle(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No command is printed, since none would succeed."""
    (tmp_path / "t.urdf").write_text(format_leaves())
    command = ["import-object", str(tmp_path / "t.urdf"), "--output", str(tmp_path / "out")]
    assert main(command) == 0
    text = capsys.readouterr().out
    assert "try:" not in text
    assert "while" not in text
    assert "no hand can open left_joint before, which is in the way" in text
    assert "no hand can open right_joint before, which is in the way" in text


def test_printed_command_opens_the_door_that_needs_no_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It opens the right leaf by its knob, although the left joint comes first in the file."""
    (tmp_path / "t.urdf").write_text(format_leaves(right=KNOB))
    output = ["--output", str(tmp_path / "out"), "--most", "1"]
    assert main(["import-object", str(tmp_path / "t.urdf"), *output]) == 0
    text = capsys.readouterr().out
    assert "while right_joint is at 2" in text
    (line,) = (line for line in text.splitlines() if line.startswith("try: "))
    assert "t.right_joint=2" in line
    assert main(shlex.split(line.removeprefix("try: vkc-pin "))) == 0


@pytest.mark.parametrize("upper", [2.0, 1.2])
def test_conditions_are_positions_that_a_hand_reaches(upper: float, tmp_path: Path) -> None:
    found = propose(format_leaves(right=KNOB, right_upper=upper), tmp_path)
    assert_openable(found)
    left = found.opening("left_joint")[0]
    assert dict(left.when) == {"right_joint": pytest.approx(found.find_goal("right_joint"))}
    assert found.find_goal("left_joint", alone=True) is None
    assert found.find_goal("right_joint", alone=True) == pytest.approx(upper)


def test_a_part_that_a_hand_opens_partly_is_no_further_open_for_the_next(tmp_path: Path) -> None:
    """A wall beside the cupboard stops the hand on the right leaf before its limit."""
    wall = format_box("0.6 0.02 0.8", "0.6 0.5 0.4")
    text = format_leaves(right=KNOB).replace('<link name="body">', f'<link name="body">{wall}')
    found = propose(text, tmp_path)
    goal = found.find_goal("right_joint", alone=True)
    assert goal is not None
    assert goal < 1.9
    assert_openable(found)
    for proposal in found.opening("left_joint"):
        assert dict(proposal.when) == {"right_joint": pytest.approx(goal)}


def test_a_push_ends_a_circle(tmp_path: Path) -> None:
    """One of two shutters is pushed up from below, which frees the handle of the other."""
    found = propose(format_leaves("prismatic"), tmp_path)
    assert_openable(found)
    assert not found.because
    kinds = {joint: found.opening(joint)[0].kind for joint in ("left_joint", "right_joint")}
    assert sorted(kind == "push" for kind in kinds.values()) == [False, True]


def format_nested_cabinet() -> str:
    """Format a cabinet with a door, a second door behind it, and a drawer behind both."""
    walls = "".join(
        format_box(size, at)
        for size, at in (
            ("0.02 0.6 1.0", "0.28 0 0.5"),
            ("0.76 0.02 1.0", "-0.1 0.31 0.5"),
            ("0.76 0.02 1.0", "-0.1 -0.31 0.5"),
            ("0.76 0.56 0.02", "-0.1 0 0.2"),
            ("0.76 0.56 0.02", "-0.1 0 0.99"),
        )
    )
    leaf = format_box("0.02 0.56 0.7", "0 -0.28 0")
    bar = format_box("0.015 0.015 0.3", "-0.06 -0.4 0")
    drawer = (
        format_box("0.3 0.3 0.02", "0.2 0 -0.15")
        + format_box("0.015 0.015 0.26", "-0.01 0.12 -0.03")
        + format_box("0.015 0.015 0.26", "-0.01 -0.12 -0.03")
        + format_box("0.015 0.255 0.015", "-0.01 0 0.1", name="handle")
    )
    return (
        f'<robot name="cabinet"><link name="body">{walls}</link><link name="drawer">{drawer}</link>'
        f'<link name="inner">{leaf}{bar}</link><link name="outer">{leaf}{bar}</link>'
        + format_joint("slide", "prismatic", "drawer", "-0.1 0 0.55", "-1 0 0", 0.3)
        + format_joint("inner_hinge", "revolute", "inner", "-0.25 0.29 0.6", "0 0 -1", 2.2)
        + format_joint("outer_hinge", "revolute", "outer", "-0.45 0.29 0.6", "0 0 -1", 2.2)
        + "</robot>"
    )


def test_conditions_are_in_the_order_of_opening(tmp_path: Path) -> None:
    """The joints are in the reverse order in the file."""
    found = propose(format_nested_cabinet(), tmp_path)
    assert_openable(found)
    assert not found.because
    assert not found.opening("outer_hinge")[0].when
    assert list(found.opening("inner_hinge")[0].when) == ["outer_hinge"]
    assert list(found.opening("slide")[0].when) == ["outer_hinge", "inner_hinge"]


@pytest.mark.parametrize("kind", ["dishwasher", "drawers", "cabinet", "refrigerator", "door"])
def test_random_furniture_can_be_opened_as_proposed(kind: str) -> None:
    item = vkc.load_object(vkc.procedural.random_object(kind, 3))
    assert_openable(vkc.importing.propose_attachments(item, most=1))


def test_rack_of_the_dishwasher_can_be_opened_as_proposed() -> None:
    found = vkc.importing.propose_attachments(vkc.load_object("dishwasher"), most=1)
    assert_openable(found)
    assert dict(found.opening("rack")[0].when) == {"door": pytest.approx(np.pi / 2.0)}
