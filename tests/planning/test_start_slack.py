"""Tests that a start may be measured slightly outside the limits of a joint, everywhere alike."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.drawers import load_drawer_scene
from helpers.expected_errors import expect_error
from oracle.judge import judge

import vkc_pin as vkc
from vkc_pin import Scene
from vkc_pin.world.models.shapes import START_SLACK

LONG = pytest.mark.long
WRIST = 5  # number of the last joint of the arm, which may turn by 2π both ways


def measure_wrist(scene: Scene, beyond: float, *, is_upper: bool = True) -> np.ndarray:
    """Return the arm's joints with the last one `beyond` a limit [rad]."""
    arm = scene.start[3:].copy()
    robot = scene.robot
    arm[WRIST] = robot.upper[3 + WRIST] + beyond if is_upper else robot.lower[3 + WRIST] - beyond
    return arm


def load_from_document(scene: Scene, arm: np.ndarray) -> Scene:
    start = {**scene.document["start"], "arm": arm.tolist()}
    return Scene.from_document({**scene.document, "start": start}, scene.folder)


@pytest.mark.parametrize("is_upper", [True, False])
@pytest.mark.parametrize("beyond", [1e-7, 1e-4, 0.004, 0.009, START_SLACK - 1e-9])
def test_all_ways_to_state_a_start_accept_the_same(beyond: float, is_upper: bool) -> None:
    scene = vkc.load_scene("door")
    arm = measure_wrist(scene, beyond, is_upper=is_upper)
    starts = [scene.with_start(arm=arm), load_from_document(scene, arm)]
    expected = arm[WRIST] if beyond > 1e-6 else np.clip(arm[WRIST], -2 * np.pi, 2 * np.pi)
    for start in starts:
        assert start.start[3 + WRIST] == pytest.approx(expected, abs=1e-12)
        again = Scene.from_document(start.document, start.folder)
        np.testing.assert_array_equal(again.start, start.start)


@pytest.mark.parametrize("beyond", [START_SLACK + 1e-6, 0.0101, 1.0, np.inf, np.nan])
def test_all_ways_to_state_a_start_refuse_the_same(beyond: float) -> None:
    scene = vkc.load_scene("door")
    arm = measure_wrist(scene, beyond)
    for make in (lambda: scene.with_start(arm=arm), lambda: load_from_document(scene, arm)):
        with expect_error("outside the joint's limits|not a finite number|finite"):
            make()


def test_measured_grasp_may_be_slightly_outside() -> None:
    scene = vkc.load_scene("household")
    held = scene.with_held({"cup": "side"})
    arm = measure_wrist(scene, 0.009)
    turned = held.with_start(arm=arm)
    measured = held.with_measured_grasp("cup", arm=arm, placement=turned.objects["cup"].placement)
    np.testing.assert_array_equal(measured.start[3:], arm)


def plan(scene: Scene, folder: Path, *steps: vkc.Step, **options: Any) -> vkc.Plan:
    """Return a plan that validation and oracle accept."""
    found = vkc.plan(scene, list(steps), **options)
    assert found.success, found.summary()
    path = found.save(folder / "plan.npz")
    assert judge(path).found == []
    assert vkc.Plan.load(path).success
    return found


@pytest.mark.parametrize(
    ("base", "is_upper"),
    [
        ("omni", True),
        ("fixed", False),
        pytest.param("differential", True, marks=LONG),
        pytest.param("omni", False, marks=LONG),
    ],
)
def test_arm_comes_back_from_outside(tmp_path: Path, base: Any, is_upper: bool) -> None:
    scene = vkc.load_scene("door")
    document = {**scene.document, "robot": {"name": "husky_ur5e", "base": base}}
    outside = Scene.from_document(document, scene.folder)
    outside = outside.with_start(arm=measure_wrist(scene, 0.009, is_upper=is_upper))
    home = scene.tool_placement()
    step = vkc.Reach(home) if base == "fixed" else vkc.GoTo(scene.start[0] + 0.2, scene.start[1])
    found = plan(outside, tmp_path, step)
    column = found.trajectory.column("wrist_3_joint")
    limit = 2 * np.pi
    assert abs(column[0]) == pytest.approx(limit + 0.009)
    assert np.abs(column[1:]).max() <= limit + 1e-5
    assert found.end_scene().start[3 + WRIST] == pytest.approx(column[-1])


@pytest.mark.parametrize("initialization", ["stationary", "interpolated", "astar", "rrt"])
def test_every_initialization_starts_from_outside(tmp_path: Path, initialization: Any) -> None:
    scene = load_drawer_scene()
    outside = scene.with_start(arm=measure_wrist(scene, 0.009))
    plan(outside, tmp_path, vkc.Actuate("drawer", {"slide": 0.3}), initialization=initialization)


@pytest.mark.parametrize("simultaneous", [pytest.param(True, marks=LONG), False])
def test_arm_may_stand_where_it_starts(tmp_path: Path, simultaneous: bool) -> None:
    """The hand lets go before the arm comes back."""
    scene = vkc.load_scene("tray")
    outside = scene.with_start(arm=measure_wrist(scene, 0.009)).with_held({"cup": "side"})
    release = vkc.Release(unsupported=True)
    alone = plan(outside, tmp_path, release)
    np.testing.assert_array_equal(alone.end_scene().start, outside.start)
    plan(outside, tmp_path, release, vkc.GoTo(-0.5, -0.3), simultaneous=simultaneous)


def make_motion(wrist: list[float]) -> tuple[Scene, vkc.Trajectory]:
    """Return a motion of the last joint, by its distances to the upper limit [rad]."""
    scene = vkc.load_scene("door")
    outside = scene.with_start(arm=measure_wrist(scene, wrist[0]))
    rows = np.tile(outside.start, (len(wrist), 1))
    rows[:, 3 + WRIST] = scene.robot.upper[3 + WRIST] + np.array(wrist)
    phases = (vkc.PhaseSpan("move", 0, len(wrist) - 1),)
    names = scene.robot.coordinates.names
    times = 2.0 * np.arange(len(wrist))
    return outside, vkc.Trajectory(names, times, rows, phases, len(names))


@pytest.mark.parametrize(
    ("wrist", "is_valid"),
    [
        ([0.009, -0.1, -0.2], True),
        ([0.009, 0.009, -0.2], True),
        ([0.009, 0.004, -0.001], True),
        ([0.009, 0.0095, -0.1], False),
        ([0.009, -0.1, 0.001], False),
        ([0.0, 0.009, -0.1], False),
        ([-0.1, -0.2, 0.009], False),
    ],
)
def test_joint_outside_may_only_come_back(
    tmp_path: Path, wrist: list[float], is_valid: bool
) -> None:
    scene, motion = make_motion(wrist)
    steps = [vkc.GoTo(*scene.start[:3])]
    report = vkc.validate(scene, steps, motion)
    mine = [one for one in report.violations if one.constraint == "limit"]
    assert bool(mine) != is_valid, report.lines()
    saved = vkc.Plan(scene, tuple(steps), vkc.Options(), motion, report, "rejected")
    theirs = [one for one in judge(saved.save(tmp_path / "p.npz")).found if one.rule == "limit"]
    assert bool(theirs) != is_valid


def make_drawer_motion(
    wrist: float, slide: list[float]
) -> tuple[Scene, list[vkc.Step], vkc.Trajectory]:
    """Return a motion of the drawer beside the robot, whose wrist is `wrist` beyond its limit."""
    scene = load_drawer_scene()
    steps: list[vkc.Step] = [vkc.Actuate("drawer", {"slide": 0.3})]
    names = (*scene.robot.coordinates.names, "drawer.slide")
    rows = np.zeros((len(slide), len(names)))
    rows[:, :-1] = scene.start
    rows[:, 3 + WRIST] = scene.robot.upper[3 + WRIST] + wrist
    rows[:, -1] = slide
    phases = (vkc.PhaseSpan("move", 0, len(slide) - 1),)
    times = 2.0 * np.arange(len(slide))
    return scene, steps, vkc.Trajectory(names, times, rows, phases, len(names) - 1)


@pytest.mark.parametrize(
    ("wrist", "slide", "outside"),
    [
        (0.0, [0.0, 0.1, 0.2], set()),
        (-0.1, [-0.005, 0.1, 0.2], set()),
        (-0.1, [-0.005, -0.005, 0.2], {"drawer.slide"}),
        (0.02, [0.0, 0.1, 0.2], {"wrist_3_joint"}),
    ],
)
def test_only_joints_of_the_robot_may_stay_outside_and_no_further_than_the_slack(
    wrist: float, slide: list[float], outside: set[str]
) -> None:
    report = vkc.validate(*make_drawer_motion(wrist, slide))
    found = {one.subject for one in report.violations if one.constraint == "limit"}
    assert found == outside, report.lines()
