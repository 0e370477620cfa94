from __future__ import annotations

from pathlib import Path

import pytest
from helpers.arm_urdf import write_arms
from helpers.texts import format_box, format_fixed_link, replace_in_file

import vkc_pin as vkc
from vkc_pin.importing.robots.hand_checks import find_envelopes


def write_caged_arm(folder: Path, *, size: str = "0.3 0.3 0.3", visual: bool = False) -> Path:
    """Write an arm whose hand is enclosed in a box, which has no visual shape by default."""
    cage = format_box(size) + (format_box(size, kind="visual") if visual else "")
    hand = '<link name="hand">'
    return replace_in_file(
        write_arms(folder),
        (hand, hand + format_box("0.05 0.14 0.06", kind="visual")),
        ("</robot>", format_fixed_link("cage", "hand", "0 0 0.1", cage) + "</robot>"),
    )


@pytest.mark.parametrize(
    "cage", [{"size": "0.02 0.02 0.02"}, {"visual": True}], ids=["small", "seen"]
)
def test_small_and_visible_shapes_are_not_envelopes(
    tmp_path: Path, cage: dict[str, object]
) -> None:
    robot = vkc.load_robot(write_caged_arm(tmp_path, **cage), pairs="all", tool_frame="hand")  # type: ignore[arg-type]
    assert find_envelopes(robot) == {}


def test_import_removes_envelopes_and_doctor_reports_them(tmp_path: Path) -> None:
    file = write_caged_arm(tmp_path / "given")
    imported = vkc.importing.import_robot(file, tmp_path / "mine", samples=50)
    assert "cage" not in imported.robot.links
    assert "cage" not in imported.robot.touch_links
    assert {"hand", "finger_a", "finger_b"} <= set(imported.robot.touch_links)
    assert "cage encloses" in str(imported)
    found = vkc.importing.doctor(vkc.load_robot(file, tool_frame="hand"), samples=5)
    assert "cage encloses" in str(found)
    assert "cage" not in str(vkc.importing.doctor(imported.robot, samples=5))
