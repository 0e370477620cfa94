"""Tests grippers whose links follow one driving joint by <mimic>."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.arm_urdf import write_arms
from helpers.telescopes import format_joint, format_link
from helpers.texts import replace_in_file

import vkc_pin as vkc

_KNUCKLE, _FINGER = 0.035, 0.035  # [m] lateral distances of the hinges at 0
_FACE = 0.008  # [m] from the hinge of a finger to its face
OPENING = 2.0 * (_KNUCKLE + _FINGER - _FACE)  # [m] between the faces at 0


def follow(factor: float = 1.0, offset: float = 0.0, leader: str = "drive") -> str:
    return f'<mimic joint="{leader}" multiplier="{factor}" offset="{offset}"/>'


def format_side(
    side: str, *, leads: bool, factor: float = 1.0, offset: float = 0.0, inside: bool = True
) -> str:
    """Return a knuckle on the hand with a finger that stays parallel, and a bar beside it.

    Both turn inwards for positive positions of the joint `drive`.
    """
    sign = 1 if side == "left" else -1
    limits = sorted((factor * 0.0 + offset, factor * 0.85 + offset))
    ends = (limits[0], limits[1])
    knuckle, finger, bar = f"{side}_knuckle", f"{side}_finger", f"{side}_bar"
    turn = sign if factor > 0.0 else -sign
    coupling = follow(factor, offset)
    parts = [
        format_link(knuckle, "0.02 0.008 0.02", f"0 {sign * 0.02} 0.02"),
        format_joint(
            "drive" if leads else f"{knuckle}_joint",
            "revolute",
            "hand",
            knuckle,
            f"0 {sign * _KNUCKLE} 0.06",
            f"{turn} 0 0",
            (0.0, 0.85) if leads else ends,
            inside="" if leads else coupling,
        ),
        format_link(finger, "0.02 0.008 0.05", f"0 {-sign * (_FACE - 0.004)} 0.025"),
        format_joint(
            f"{finger}_joint",
            "revolute",
            knuckle,
            finger,
            f"0 {sign * _FINGER} 0.035",
            f"{-turn} 0 0",
            ends,
            inside=coupling,
        ),
    ]
    if inside:
        parts += [
            format_link(bar, "0.02 0.006 0.03", f"0 {sign * 0.02} 0.02"),
            format_joint(
                f"{bar}_joint",
                "revolute",
                "hand",
                bar,
                f"0 {sign * 0.015} 0.07",
                f"{turn} 0 0",
                ends,
                inside=coupling,
            ),
        ]
    return "".join(parts)


def write_gripper(folder: Path, *parts: str) -> Path:
    """Write an arm whose fingers are replaced by some links and joints."""
    path = write_arms(folder)
    text = path.read_text(encoding="utf-8")
    fingers = text[text.index('<link name="finger_a">') :]
    return replace_in_file(path, (fingers, "".join((*parts, "</robot>"))))


MOTOR = format_link("motor") + format_joint(
    "drive", "revolute", "hand", "motor", limits=(0.0, 0.85)
)


@pytest.mark.parametrize(
    "parts",
    [
        [format_side("left", leads=True), format_side("right", leads=False)],
        [format_side("left", leads=False), format_side("right", leads=True)],
        [format_side("left", leads=True), format_side("right", leads=False, factor=-1.0)],
        [MOTOR, format_side("left", leads=False), format_side("right", leads=False)],
        [MOTOR, *(format_side(side, leads=False, factor=-1.0) for side in ("left", "right"))],
        [
            format_side("left", leads=True, inside=False),
            format_side("right", leads=False, inside=False),
        ],
    ],
    ids=["left", "right", "mirrored", "motor", "reversed", "without bars"],
)
def test_one_joint_drives_all_fingers(tmp_path: Path, parts: list[str]) -> None:
    file = write_gripper(tmp_path / "given", *parts)
    imported = vkc.importing.import_robot(file, tmp_path / "mine", samples=60)
    stated = yaml.safe_load((imported.folder / "robot.yaml").read_text(encoding="utf-8"))
    assert stated["gripper"] == {"drive": {"closed": 0.85, "open": 0.0}}
    assert f"to {1e3 * OPENING:.0f} mm" in str(imported)
    gripper = imported.robot.gripper
    assert gripper is not None
    assert gripper.max_opening > gripper.min_opening + 0.02
    assert imported.diagnosis.healthy


def test_slides_of_four_fingers_follow_one_motor(tmp_path: Path) -> None:
    """Two slides on either side follow a motor that turns by 1 rad and moves each by 30 mm."""
    motor = format_link("motor") + format_joint(
        "drive", "revolute", "hand", "motor", limits=(0.0, 1.0)
    )
    parts = [motor]
    for k, (x, sign) in enumerate(((-0.005, 1), (0.005, 1), (-0.005, -1), (0.005, -1))):
        name = f"finger_{k}"
        parts.append(format_link(name, "0.01 0.01 0.08", f"0 {sign * 0.005} 0.04"))
        parts.append(
            format_joint(
                f"{name}_joint",
                "prismatic",
                "hand",
                name,
                f"{x} 0 0.06",
                f"0 {sign} 0",
                (0.0, 0.03),
                inside=follow(0.03),
            )
        )
    file = write_gripper(tmp_path / "given", *parts)
    imported = vkc.importing.import_robot(file, tmp_path / "mine", samples=60)
    gripper = imported.robot.gripper
    assert gripper is not None
    stated = yaml.safe_load((imported.folder / "robot.yaml").read_text(encoding="utf-8"))
    assert stated["gripper"].keys() == {"drive"}
    assert gripper.max_opening == pytest.approx(0.06, abs=2e-3)
    assert gripper.min_opening == pytest.approx(0.0, abs=2e-3)


def format_swinging_side(sign: int, length: float, y: float, limits: tuple[float, float]) -> str:
    """Return a bar that swings from the hand, and a pad at its end that stays parallel.

    The left one leads. The pad is 40 mm long and 8 mm thick.
    """
    side = "left" if sign > 0 else "right"
    bar, pad = f"{side}_bar", f"{side}_pad"
    turned = (-limits[1], -limits[0])
    return "".join(
        [
            format_link(bar, f"0.02 0.008 {length}", f"0 0 {length / 2.0}"),
            format_joint(
                "drive" if sign > 0 else f"{bar}_joint",
                "revolute",
                "hand",
                bar,
                f"0 {sign * y} 0.06",
                f"{sign} 0 0",
                limits,
                inside="" if sign > 0 else follow(),
            ),
            format_link(pad, "0.02 0.008 0.04", "0 0 0.02"),
            format_joint(
                f"{pad}_joint",
                "revolute",
                bar,
                pad,
                f"0 0 {length}",
                f"{sign} 0 0",
                turned,
                inside=follow(-1.0),
            ),
        ]
    )


@pytest.mark.parametrize(
    ("length", "y", "limits"),
    [
        (0.08, 0.07, (0.0, 0.8)),
        (0.1, 0.06, (-0.2, 0.5)),
        (0.12, 0.1, (0.0, 0.75)),
        (0.05, 0.055, (-0.1, 1.0)),
        (0.09, 0.075, (0.0, 0.78)),
        (0.07, 0.065, (0.0, 0.9)),
        (0.06, 0.04, (-0.6, 0.5)),
        (0.1, 0.02, (-0.7, 0.1)),  # the pads come forward as they close
    ],
)
def test_fingers_that_draw_back_as_they_close_enclose_the_tool_frame(
    tmp_path: Path, length: float, y: float, limits: tuple[float, float]
) -> None:
    sides = [format_swinging_side(sign, length, y, limits) for sign in (1, -1)]
    file = write_gripper(tmp_path / "given", *sides)
    imported = vkc.importing.import_robot(file, tmp_path / "mine", samples=60)
    gripper = imported.robot.gripper
    assert gripper is not None
    low, high = limits
    for opening, angle in ((gripper.max_opening, low), (gripper.min_opening, high)):
        assert opening == pytest.approx(2.0 * (y - length * np.sin(angle) - 0.004), abs=1e-3)
