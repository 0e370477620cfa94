"""Tests pairs, states and groups of SRDF files."""

from __future__ import annotations

from pathlib import Path

import pytest

from vkc_pin.world.files.srdf import Srdf, read_srdf

LINKS = ("base", "arm", "hand")


def read_text(folder: Path, content: str) -> Srdf:
    (folder / "r.srdf").write_text(f'<robot name="r">\n{content}\n</robot>')
    return read_srdf(folder / "r.srdf", links=LINKS)


def format_state(name: str, **joints: str) -> str:
    values = "".join(f'<joint name="{joint}" value="{value}"/>' for joint, value in joints.items())
    return f'<group_state name="{name}" group="all">{values}</group_state>'


def test_pairs_are_sorted_and_keep_their_reason(tmp_path: Path) -> None:
    pairs = (
        '<disable_collisions link1="hand" link2="arm" reason="Adjacent"/>'
        '<disable_collisions link1="arm" link2="base"/>'
    )
    assert read_text(tmp_path, pairs).allowed == {("arm", "hand"): "Adjacent", ("arm", "base"): ""}


def test_states_of_several_groups_are_merged(tmp_path: Path) -> None:
    """Joints with several coordinates are skipped."""
    srdf = read_text(
        tmp_path,
        format_state("home", a="0.5")
        + format_state("up", a="-1e-1", floating="1 0 0")
        + format_state("home", b="2"),
    )
    assert srdf.states == {"home": {"a": 0.5, "b": 2.0}, "up": {"a": -0.1}}


@pytest.mark.parametrize(
    ("names", "chosen"),
    [
        (["up", "rest", "home"], "home"),
        (["up", "rest"], "rest"),
        (["down", "up"], "down"),
        (["up", "default", "rest"], "default"),
    ],
)
def test_home_states_are_preferred(tmp_path: Path, names: list[str], chosen: str) -> None:
    values = {name: float(number) for number, name in enumerate(names)}
    srdf = read_text(
        tmp_path,
        "".join(format_state(name, a=str(value), b="0") for name, value in values.items())
        + format_state("home", c="1"),
    )
    assert srdf.state(["a", "b"])["a"] == values[chosen]
    assert srdf.state(["a", "z"]) == {}
