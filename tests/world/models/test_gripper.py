"""Tests the opening of grippers and their description in robot.yaml."""

from __future__ import annotations

from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest
from helpers.expected_errors import expect_error
from helpers.grippers import MAX_OPENING, write_gripper
from helpers.robots import compute_placement, get_home_configuration
from hypothesis import given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.world.models.gripper import WIDTH_TOLERANCE, check_bar_fits, find_widest_bar


@pytest.mark.parametrize(
    ("left", "right", "y", "width"),
    [
        (0.04, 0.04, 0.0, 0.08),
        (0.01, 0.04, 0.0, 0.02),
        (0.1, 0.02, 0.0, 0.04),
        (-0.01, 0.04, 0.0, 0.0),
        (0.04, 0.04, 0.6, None),  # beside the bar
    ],
)
def test_the_nearer_wall_limits_the_width(
    left: float, right: float, y: float, width: float | None
) -> None:
    walls = [
        (coal.Box(0.1, 1.0, 1.0), pin.SE3(np.eye(3), np.array([x, y, 0.0])))
        for x in (-left - 0.05, right + 0.05)
    ]
    found = find_widest_bar(walls)
    if width is None:
        assert found > 0.4
    else:
        assert found == pytest.approx(width, abs=WIDTH_TOLERANCE)
        assert width == 0.0 or check_bar_fits(width - 1e-5, walls)
        assert not check_bar_fits(width + 1e-5, walls)


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> vkc.Robot:
    return vkc.load_robot(write_gripper(tmp_path_factory.mktemp("gripper")))


def compute_finger_centers(robot: vkc.Robot) -> list[np.ndarray]:
    """Return the centres of the fingers' shapes in the tool frame."""
    data, shapes = robot.model.createData(), robot.collision.createData()
    q = robot.coordinates.q(get_home_configuration(robot))
    pin.updateGeometryPlacements(robot.model, data, robot.collision, shapes, q)
    tool = compute_placement(robot, robot.tool_frame, get_home_configuration(robot))
    fingers = [k for k in range(len(shapes.oMg)) if robot.link_of(k).startswith("finger")]
    return [tool.actInv(shapes.oMg[k]).translation for k in fingers]


def test_grippers_are_open_by_default_and_mimic_joints_follow(robot: vkc.Robot) -> None:
    gripper = robot.gripper
    assert gripper is not None
    assert gripper.names == ("finger_a_joint", "finger_b_joint")
    assert gripper.rest_opening == gripper.max_opening == pytest.approx(MAX_OPENING, abs=2e-4)
    assert gripper.min_opening == 0.0
    assert robot.opened(None) is robot
    np.testing.assert_allclose(gripper.compute_positions(None), [0.04, 0.04])
    np.testing.assert_allclose(gripper.compute_positions(0.0), [0.0, 0.0])


@settings(max_examples=20, deadline=None)
@given(opening=st.floats(0.0, 0.0799))
def test_fingers_are_symmetric_at_the_given_opening(robot: vkc.Robot, opening: float) -> None:
    opened = robot.opened(opening)
    for center, side in zip(compute_finger_centers(opened), (1.0, -1.0), strict=True):
        assert center[0] == pytest.approx(side * (opening / 2.0 + 0.005), abs=1e-5)  # 10 mm thick
    z = get_home_configuration(robot)
    for link in ("finger_a", "finger_b", "hand", "tool"):
        moved = compute_placement(opened, link, z).actInv(compute_placement(robot, link, z))
        distance = (MAX_OPENING - opening) / 2.0 if link.startswith("finger") else 0.0
        assert np.linalg.norm(moved.translation) == pytest.approx(distance, abs=1e-5)


def test_opened_robots_are_cached_and_keep_their_margins(robot: vkc.Robot) -> None:
    opened = robot.opened(0.03)
    assert opened is robot.opened(0.03)
    assert opened.own_margins(0.02) == robot.own_margins(0.02)


def test_openings_are_clamped_to_the_range(robot: vkc.Robot) -> None:
    gripper = robot.gripper
    assert gripper is not None
    assert robot.opening(None) is None
    assert robot.opening(0.05) == 0.05
    assert robot.opening(0.3) == gripper.max_opening
    with expect_error(r"out of the gripper.s range.*0 to 0\.0799"):
        robot.opened(0.3)


def test_robots_without_gripper_have_no_opening() -> None:
    robot = vkc.load_robot("husky_ur5e")
    assert robot.opening(0.05) is None
    with expect_error("no gripper that opens"):
        robot.opened(0.05)


def test_openings_of_revolute_fingers(tmp_path: Path) -> None:
    """Inner faces pass through the joint axes; the near edge of the bar is 64 mm ahead."""
    file = write_gripper(tmp_path, gripper="gripper: {finger_a_joint: {closed: 0.0, open: 0.5}}\n")
    urdf = file.parent / "robot.urdf"
    text = urdf.read_text()
    text = text.replace('type="prismatic"', 'type="revolute"').replace(
        'upper="0.04"', 'upper="0.5"'
    )
    for name, sign in (("a", 1), ("b", -1)):
        before, joint, after = text.partition(f'<joint name="finger_{name}_joint"')
        after = after.replace('xyz="0 0 0.06"', f'xyz="0 {sign * 0.01} 0.06"', 1)
        after = after.replace(f'<axis xyz="0 {sign} 0"/>', f'<axis xyz="{-sign} 0 0"/>', 1)
        text = before + joint + after
    urdf.write_text(text)
    gripper = vkc.load_robot(file).gripper
    assert gripper is not None
    assert gripper.min_opening == pytest.approx(0.02, abs=2e-4)
    assert gripper.max_opening == pytest.approx(0.02 + 2.0 * 0.064 * np.tan(0.5), abs=2e-4)
    for opening in (0.03, 0.05, 0.08):
        angle = np.arctan((opening / 2.0 - 0.01) / 0.064)
        np.testing.assert_allclose(gripper.compute_positions(opening), [angle, angle], atol=1e-4)


@pytest.mark.parametrize(
    ("gripper", "problem"),
    [
        ("finger_c_joint: {closed: 0, open: 0.04}", "finger_a_joint"),
        ("finger_a_joint: {closed: 0}", r"gripper\.finger_a_joint\.open.*missing"),
        ("finger_a_joint: {closed: 0, opened: 0.04}", "did you mean 'open'"),
        ("finger_a_joint: {closed: 0, open: 0.4}", "between 0 and 0.04"),
        ("finger_a_joint: {closed: 0.04, open: 0.04}", "does not move"),
        ("finger_a_joint: {closed: 0.04, open: 0.0}", "does not open"),
        ("finger_b_joint: {closed: 0, open: 0.04}", "which it follows"),
        ("arm_5_joint: {closed: 0, open: 0.04}", "not a finger joint"),
    ],
)
def test_invalid_grippers_raise_with_file_and_line(
    tmp_path: Path, gripper: str, problem: str
) -> None:
    file = write_gripper(tmp_path, gripper=f"gripper: {{{gripper}}}\n")
    with expect_error(problem, file=file, line=6):
        vkc.load_robot(file)
