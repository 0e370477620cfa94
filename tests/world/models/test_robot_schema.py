"""Tests the validation of robot.yaml."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.robots import write_small_urdf

from vkc_pin.errors import InputError
from vkc_pin.world.models.robot_file import load_robot


@pytest.mark.parametrize(
    ("text", "line", "problem"),
    [
        ("tool_fram: l3", 2, "tool_frame"),
        ("tool_frame: l9", None, "l3"),
        ("home: {j7: 0}", 2, "j[0-2]"),
        ("home: {j1: 3}", None, "between -2 and 2"),
        ("joints: {j2: {velocity: fast}}", 2, "number"),
        ("joints: {k2: {velocity: 1}}", 2, "j2"),
        ("touch_links: [hand]", 2, "l0"),
        ("packages: [no_such_package_here]", 2, "pip install no-such-package-here"),
        ("base: {position: [[1, -1], [0, 1]]}", 2, "lower"),
        ("srdf: none.srdf", None, "none.srdf"),
    ],
)
def test_invalid_robot_yaml_raises_with_its_line(
    tmp_path: Path, text: str, line: int | None, problem: str
) -> None:
    write_small_urdf(tmp_path)
    (tmp_path / "robot.yaml").write_text(f"urdf: small.urdf\n{text}\n")
    with pytest.raises(InputError, match=problem) as caught:
        load_robot(tmp_path / "robot.yaml")
    assert caught.value.file is not None
    if line is not None:
        assert (caught.value.file, caught.value.line) == (tmp_path / "robot.yaml", line)
