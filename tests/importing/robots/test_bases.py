"""Tests the root, floor and base joints of imported mobile robots."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import yaml
from helpers.arm_urdf import HEIGHT, write_arms
from helpers.telescopes import format_joint, format_link
from helpers.texts import format_fixed_link, replace_in_file
from helpers.wheels import format_steered_wheel, format_wheel, write_wheeled_robot

import vkc_pin as vkc

SAMPLES = 60
WHEELS = ("left_wheel", "right_wheel")
BEHIND = [format_wheel(name, -0.25, y) for name, y in zip(WHEELS, (0.25, -0.25), strict=True)]
AHEAD = [
    format_wheel("left_wheel", 0.2, 0.25),
    format_wheel("right_wheel", 0.2, -0.25, axis="0 -1 0"),
]
SIDEWAYS = [
    format_wheel(name, x, -0.1, axis="1 0 0") for name, x in zip(WHEELS, (-0.3, 0.3), strict=True)
]
OBLIQUE = [
    format_wheel(name, 0.1 - 0.18 * side, 0.05 + 0.24 * side, axis="-0.6 0.8 0")
    for name, side in zip(WHEELS, (1, -1), strict=True)
]
REVERSED = [
    format_wheel(name, -0.3, y, axis="0 -1 0")
    for name, y in zip(WHEELS, (-0.25, 0.25), strict=True)
]
CASTERS = [format_steered_wheel("caster_wheel", 0.2, 0.0, trail=0.05)]


def import_wheeled(folder: Path, *wheels: str) -> vkc.importing.ImportedRobot:
    file = write_wheeled_robot(folder / "given", *wheels)
    return vkc.importing.import_robot(file, folder / "mine", samples=SAMPLES)


def measure_slip(plan: vkc.Plan, robot: vkc.Robot) -> float:
    """Return the largest speed of the wheels along their axles [m/s], by differences."""
    data = robot.model.createData()
    times = np.linspace(0.0, plan.trajectory.times[-1], 1500)
    positions, axles = [], []
    for time in times:
        z = plan.trajectory.at(time)[: len(robot.lower)]
        pin.framesForwardKinematics(robot.model, data, robot.coordinates.q(z))
        places = [data.oMf[robot.model.getFrameId(name)] for name in WHEELS]
        positions.append([place.translation for place in places])
        axis = places[1].translation - places[0].translation
        axles.append(axis / np.linalg.norm(axis))
    velocity = np.gradient(np.array(positions), times, axis=0)
    return float(np.abs(np.einsum("tki,ti->tk", velocity, np.array(axles))).max())


@pytest.mark.parametrize(
    "wheels",
    [BEHIND, AHEAD, SIDEWAYS, OBLIQUE, REVERSED, [*BEHIND, *CASTERS]],
    ids=["behind", "mirrored", "sideways", "oblique", "reversed", "casters"],
)
def test_wheels_roll_without_sliding(tmp_path: Path, wheels: list[str]) -> None:
    imported = import_wheeled(tmp_path, *wheels)
    assert imported.diagnosis.healthy
    assert "left_wheel_joint, right_wheel_joint is" in str(imported)
    scene = vkc.load_scene(imported.folder / "scene.yaml")
    assert scene.robot.base == "differential"
    plan = vkc.plan(scene, [vkc.GoTo(1.0, 0.6, 1.2)])
    assert plan.success, plan.summary()
    assert measure_slip(plan, scene.robot) < 0.005  # [m/s], the error of differences
    assert not any(item.topic == "base" for item in vkc.importing.doctor(scene.robot).findings)


def test_root_stays_if_it_is_on_the_axle(tmp_path: Path) -> None:
    """The root on the floor is above the body's own one, at the same place and heading."""
    wheels = [format_wheel(name, 0.0, y) for name, y in zip(WHEELS, (0.3, -0.2), strict=True)]
    robot = import_wheeled(tmp_path, *wheels).robot
    body = robot.model.frames[robot.model.getFrameId("body")].placement
    assert body.isApprox(pin.SE3(np.eye(3), np.array([0.0, 0.0, HEIGHT])), 1e-6)


def test_root_of_a_car_is_on_its_rear_axle(tmp_path: Path) -> None:
    front = [format_steered_wheel(f"front_{y}_wheel", 0.3, 0.25 * y, limit=0.6) for y in (1, -1)]
    imported = import_wheeled(tmp_path, *BEHIND, *front)
    scene = vkc.load_scene(imported.folder / "scene.yaml")
    assert scene.robot.base == "ackermann"
    assert scene.robot.turning_radius == pytest.approx(0.55 / np.tan(0.6) + 0.25, abs=1e-3)
    body = scene.robot.model.frames[scene.robot.model.getFrameId("body")].placement
    assert body.translation == pytest.approx([0.25, 0.0, HEIGHT], abs=1e-6)


@pytest.mark.filterwarnings("ignore")
def test_doctor_names_an_axle_away_from_the_root(tmp_path: Path) -> None:
    file = write_wheeled_robot(tmp_path, *SIDEWAYS)
    for base, level in (("omni", "warning"), ("differential", "fault"), ("fixed", None)):
        diagnosis = vkc.importing.doctor(vkc.load_robot(file, base=base), samples=5)  # type: ignore[arg-type]
        found = [item for item in diagnosis.findings if item.topic == "base"]
        assert [item.level for item in found] == ([] if level is None else [level])
        for item in found:
            assert "0.100 m from the root link, at x 0.000, y -0.100" in item.text
            assert "rolls at 90° from its x axis" in item.text


@pytest.mark.parametrize("name", ["base_footprint", "my_base_footprint_link"])
@pytest.mark.parametrize("height", [0.4, 0.3])
def test_footprint_is_on_the_floor(tmp_path: Path, name: str, height: float) -> None:
    """The lowest shape of the body is `HEIGHT` below it, here 50 mm above or below the floor."""
    file = write_arms(tmp_path / "given")
    foot = f'<link name="{name}"/><joint name="foot" type="fixed"><parent link="{name}"/>'
    foot += f'<child link="body"/><origin xyz="0 0 {height}"/></joint></robot>'
    replace_in_file(file, ("</robot>", foot))
    robot = vkc.importing.import_robot(file, tmp_path / "mine", samples=SAMPLES).robot
    body = robot.model.frames[robot.model.getFrameId("body")].placement
    assert body.translation == pytest.approx([0.0, 0.0, height], abs=1e-6)


def write_on_slides(
    folder: Path, kinds: str, *, limits: tuple[float, float] = (-1.0, 1.0), wheels: bool = True
) -> Path:
    """Write a robot on a chain of joints without shapes, e.g. "px py pz rz", with wheels."""
    axes = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
    chain, parent = format_link("world"), "world"
    words = kinds.split()
    for k, (kind, axis) in enumerate(words):
        child = "body" if k == len(words) - 1 else f"on_{k}"
        chain += "" if child == "body" else format_link(child)
        name = "prismatic" if kind == "p" else "revolute"
        chain += format_joint(f"drive_{k}", name, parent, child, axis=axes[axis], limits=limits)
        parent = child
    if wheels:
        chain += "".join(
            format_wheel(name, 0.0, y) for name, y in (("lwheel", 0.2), ("rwheel", -0.2))
        )
    return replace_in_file(write_arms(folder), ("</robot>", f"{chain}</robot>"))


@pytest.mark.parametrize(
    ("kinds", "limits", "wheels"),
    [
        ("px py pz", (-1.0, 1.0), True),
        ("pz px py rz", (0.0, 0.5), True),
        ("pz", (0.0, 0.5), True),
        ("px py pz rx ry rz", (-1.0, 1.0), True),
        ("px py pz", (-20.0, 20.0), False),
        ("px py pz rz", (-1e16, 1e16), False),
    ],
)
def test_slides_below_the_wheels_are_locked(
    tmp_path: Path, kinds: str, limits: tuple[float, float], wheels: bool
) -> None:
    file = write_on_slides(tmp_path / "given", kinds, limits=limits, wheels=wheels)
    imported = vkc.importing.import_robot(file, tmp_path / "mine", samples=SAMPLES)
    names = imported.robot.coordinates.names[3:]
    assert names == tuple(f"arm_{k}_joint" for k in range(1, 6))
    stated = yaml.safe_load((imported.folder / "robot.yaml").read_text(encoding="utf-8"))
    for k in range(len(kinds.split())):
        assert stated["locked_joints"][f"drive_{k}"] == 0.0


def test_lift_above_a_base_is_planned(tmp_path: Path) -> None:
    """Without wheels, and with the travel of a lift, a vertical slide belongs to the arm."""
    file = write_on_slides(tmp_path / "given", "px py rz pz", limits=(0.0, 0.5), wheels=False)
    imported = vkc.importing.import_robot(file, tmp_path / "mine", samples=SAMPLES)
    assert imported.robot.coordinates.names[3] == "drive_3"
    lifted = write_arms(tmp_path / "lifted")
    wheels = "".join(
        format_wheel(name, 0.0, y, parent="cart") for name, y in (("lwheel", 0.2), ("rwheel", -0.2))
    )
    cart = format_fixed_link("plate", "cart", "0 0 -0.2", "")
    cart += format_link("cart", "0.5 0.4 0.1", "0 0 -0.3") + wheels
    cart += format_joint("lift", "prismatic", "cart", "body", limits=(0.0, 0.5))
    replace_in_file(lifted, ("</robot>", f"{cart}</robot>"))
    imported = vkc.importing.import_robot(lifted, tmp_path / "mine_too", samples=SAMPLES)
    assert imported.robot.coordinates.names[3] == "lift"
