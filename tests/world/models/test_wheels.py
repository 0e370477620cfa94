"""Tests how bases drive, from the placements and axes of their wheels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.texts import format_fixed_link
from helpers.wheels import format_steered_wheel, format_wheel, write_wheeled_robot

import vkc_pin as vkc
from vkc_pin.world.files.urdf import read_urdf
from vkc_pin.world.models.robot import Base
from vkc_pin.world.models.robot_model import build_full_model
from vkc_pin.world.models.wheels import Drive, describe_misplaced_axle, find_drive, is_on_axle


def find_base(folder: Path, *wheels: str) -> Drive | None:
    file = read_urdf(write_wheeled_robot(folder, *wheels))
    return find_drive(build_full_model(file), file)


def make_pair(x: float, *, axes: tuple[str, str] = ("0 1 0", "0 1 0"), **at: float) -> list[str]:
    y = at.get("y", 0.0)
    return [
        format_wheel("left_wheel", x, y + 0.25, axis=axes[0]),
        format_wheel("right_wheel", x, y - 0.25, axis=axes[1]),
    ]


ACROSS = [
    format_wheel("a_wheel", -0.25, 0.1, axis="1 0 0"),
    format_wheel("b_wheel", 0.25, 0.1, axis="-1 0 0"),
]


@pytest.mark.parametrize(
    ("wheels", "center", "yaw"),
    [
        (make_pair(0.0), (0.0, 0.0), 0.0),
        (make_pair(-0.25), (-0.25, 0.0), 0.0),
        (make_pair(0.3, axes=("0 1 0", "0 -1 0")), (0.3, 0.0), 0.0),  # mirrored axes
        (make_pair(-0.2, axes=("0 -1 0", "0 -1 0")), (-0.2, 0.0), 0.0),
        (make_pair(0.0, y=0.1), (0.0, 0.0), 0.0),  # the axle passes through the root
        (make_pair(0.1, axes=("0 0.98 0.2", "0 0.98 -0.2")), (0.1, 0.0), 0.0),  # wheels that lean
        (ACROSS, (0.0, 0.1), np.pi / 2.0),
        ([*make_pair(0.2), format_wheel("rear_wheel", -0.4, 0.0)], (0.0, 0.0), 0.0),
        ([*make_pair(-0.1), format_steered_wheel("front_wheel", 0.3, 0.0)], (-0.1, 0.0), 0.0),
        ([*make_pair(-0.1), format_wheel("caster_wheel", 0.3, 0.0)], (-0.1, 0.0), 0.0),
        ([format_wheel("drivewhl_l", -0.1, 0.2, kind="revolute")], (-0.1, 0.0), 0.0),
    ],
)
def test_axle_is_that_of_unsteered_wheels(
    tmp_path: Path, wheels: list[str], center: tuple[float, float], yaw: float
) -> None:
    drive = find_base(tmp_path, *wheels)
    assert drive is not None
    assert drive.kind == "differential"
    np.testing.assert_allclose(drive.center, center, atol=1e-9)
    assert drive.yaw == pytest.approx(yaw, abs=1e-9)
    assert is_on_axle(drive) == (not any(center) and not yaw)


def test_axle_of_wheels_on_a_turned_frame(tmp_path: Path) -> None:
    """A frame on the body, 0.2 m ahead of it and turned by 30°, carries the wheels."""
    frame = (
        '<link name="frame"/><joint name="mount" type="fixed"><parent link="body"/>'
        f'<child link="frame"/><origin xyz="0.2 0 0" rpy="0 0 {np.pi / 6}"/></joint>'
    )
    sides = (("left_wheel", 0.25), ("right_wheel", -0.25))
    wheels = [format_wheel(name, 0.0, y, parent="frame") for name, y in sides]
    drive = find_base(tmp_path, frame, *wheels)
    assert drive is not None
    assert drive.yaw == pytest.approx(np.pi / 6)
    ahead = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6)])
    np.testing.assert_allclose(drive.center, 0.2 * np.cos(np.pi / 6) * ahead, atol=1e-9)
    text = describe_misplaced_axle(drive)
    assert "left_wheel_joint, right_wheel_joint" in text
    assert "30°" in text
    assert "0.173 m" in text


@pytest.mark.parametrize(
    "wheels",
    [
        [format_steered_wheel(f"{k}_wheel", x, 0.2) for k, x in enumerate((-0.3, 0.3))],
        [format_steered_wheel(f"{k}_wheel", x, 0.2, limit=1.5) for k, x in enumerate((-0.3, 0.3))],
        [
            format_wheel(f"wheel_{k}", np.cos(a), np.sin(a), axis=f"{np.cos(a)} {np.sin(a)} 0")
            for k, a in enumerate((0.0, 2.1, 4.2))
        ],
        [*make_pair(0.0), format_fixed_link("mecanum_mount", "body")],
    ],
    ids=["casters", "swerve", "three", "mecanum"],
)
def test_base_of_other_wheels_drives_sideways(tmp_path: Path, wheels: list[str]) -> None:
    drive = find_base(tmp_path, *wheels)
    assert drive is not None
    assert drive.kind == "omni"
    assert is_on_axle(drive)


@pytest.mark.parametrize("y", [0.0, 0.2])
def test_car_has_a_turning_radius(tmp_path: Path, y: float) -> None:
    """The front wheels, 0.6 m ahead of the rear axle, turn by 0.5 rad: the inner one limits it."""
    sides = (y, -y) if y else (0.0,)
    front = [
        format_steered_wheel(f"front_{k}_wheel", 0.4, side, limit=0.5)
        for k, side in enumerate(sides)
    ]
    drive = find_base(tmp_path, *make_pair(-0.2), *front)
    assert drive is not None
    assert (drive.kind, drive.center[0]) == ("ackermann", pytest.approx(-0.2))
    assert drive.turning_radius == pytest.approx(0.6 / np.tan(0.5) + y)
    assert len(drive.wheels) == 2


def test_robot_without_wheels_has_no_drive(tmp_path: Path) -> None:
    assert find_base(tmp_path) is None
    upright = format_wheel("hand_wheel", 0.0, 0.0, axis="0 0 1")  # it turns, but cannot roll
    assert find_base(tmp_path, upright) is None


@pytest.mark.parametrize("base", ["differential", "omni", "fixed"])
@pytest.mark.filterwarnings("ignore:.*not checked")
def test_loading_warns_of_wheels_that_would_slide(tmp_path: Path, base: Base) -> None:
    file = write_wheeled_robot(tmp_path, *make_pair(-0.25))
    if base == "differential":
        with pytest.warns(UserWarning, match=r"left_wheel_joint.* is 0\.250 m behind the root"):
            vkc.load_robot(file, base=base, pairs="all")
    else:
        vkc.load_robot(file, base=base, pairs="all")
