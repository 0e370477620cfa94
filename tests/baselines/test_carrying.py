"""The baselines carry a cup from table to table, and drive with the arm as it is."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import describe_box
from helpers.drawers import (
    compute_handle_pose,
    compute_pose_error,
    load_drawer_scene,
    make_grasping_scene,
    make_open_scene,
)
from helpers.drives import make_hall
from helpers.small_problems import make_program

import vkc_pin as vkc
from vkc_pin.baselines import plan_separately
from vkc_pin.baselines.postures import generate_postures
from vkc_pin.world.trajectory.world_model import World

OPTIONS = vkc.Options(reach_waypoints=20, move_waypoints=15)
CUP, THERE = (
    (1.5, 0.1, 0.501),
    (-0.2, 1.7, 0.701),
)  # on a table before the robot, and on one to its left
CARRY = vkc.Place("cup", THERE)
CARRIED = [
    "go to",
    "reach cup.side",
    "go to",
    "go to",
    "place cup",
    "let go",
]  # drive, reach, draw back, drive, put down
PULL = vkc.Actuate("drawer", {"slide": 0.15})


def make_room(*more: dict[str, Any], arm: np.ndarray | None = None) -> vkc.Scene:
    """Return a hall with two tables, and a cup on one of them."""
    tables = [
        describe_box("table", [0.6, 0.8, 0.02], [1.7, 0.1, 0.49]),
        describe_box("other", [0.8, 0.6, 0.02], [-0.2, 1.9, 0.69]),
    ]
    scene = make_hall(obstacles=[*tables, *more])
    cup = {"name": "cup", "type": "cup", "position": list(CUP), "yaw": 0.4}
    scene = vkc.Scene.from_document({**scene.document, "objects": [cup]}, scene.folder)
    return scene if arm is None else scene.with_start(arm=arm)


def plan(scene: vkc.Scene, *steps: vkc.Step, **arguments: Any) -> vkc.Plan:
    return plan_separately(scene, steps, **{"options": OPTIONS, "retries": 1, **arguments})


@cache
def carry_cup(method: str = "B1") -> vkc.Plan:
    return plan(make_room(), CARRY, method=method)


@cache
def pull_and_drive() -> vkc.Plan:
    return plan(make_open_scene(), PULL, vkc.GoTo(-1.0, 1.0))


def list_phase_names(found: vkc.Plan) -> list[str]:
    return [phase.name for phase in found.trajectory.phases]


def get_rows(found: vkc.Plan, phase: int) -> np.ndarray:
    """Return the waypoints of a phase, the robot's columns."""
    span = found.trajectory.phases[phase]
    return np.array(
        found.trajectory.positions[span.first : span.last + 1, : found.trajectory.robot_size]
    )


def compute_placement(found: vkc.Plan, waypoint: int, name: str = "cup") -> pin.SE3:
    """Return the placement of an object at a waypoint, by the world model of validation."""
    world = World(found.scene)
    return world.get_placement(name, world.compute_positions(found.trajectory)[waypoint])


def test_cup_is_carried_from_table_to_table() -> None:
    found = carry_cup()
    assert found.success, found.summary()
    assert vkc.validate(found.scene, found.steps, found.trajectory, found.options).ok
    assert list_phase_names(found) == CARRIED
    assert [dict(phase.held) for phase in found.trajectory.phases] == [
        {},
        {},
        *[{"cup": "side"}] * 3,
        {},
    ]
    end = compute_placement(found, -1)
    np.testing.assert_allclose(end.translation, THERE, atol=1e-3)
    assert end.rotation[2, 2] > np.cos(1e-3), "it stands upright"


def test_base_and_arm_move_one_after_the_other() -> None:
    found = carry_cup()
    for drives in (0, 3):
        arm = get_rows(found, drives)[:, 3:]
        assert np.ptp(get_rows(found, drives)[:, :2], axis=0).max() > 0.3
        np.testing.assert_array_equal(arm, np.tile(arm[0], (len(arm), 1)))
    for moves in (1, 2, 4):
        base = get_rows(found, moves)[:, :3]
        assert np.ptp(get_rows(found, moves)[:, 3:], axis=0).max() > 0.05
        np.testing.assert_allclose(base, np.tile(base[0], (len(base), 1)), atol=1e-12)


def test_object_grasped_at_the_start() -> None:
    before = carry_cup()
    span = before.trajectory.phases[3]
    row = before.trajectory.positions[span.first]
    at = [
        float(row[before.trajectory.names.index(f"cup.side_{name}")]) for name in ("slide", "turn")
    ]
    scene = make_room().with_start(base=row[:3], arm=row[3:9])
    attachment = scene.objects["cup"].object.attachments["side"]
    values = dict(zip(("slide", "turn"), at, strict=True))
    held = scene.with_held(
        {"cup": "side"},
        at={"cup": [values[name.removeprefix("side_")] for name in attachment.coordinates]},
    )
    found = plan(held, CARRY)
    assert found.success, found.summary()
    assert list_phase_names(found) == ["go to", "place cup", "let go"]


def test_drive_after_an_actuation() -> None:
    found = pull_and_drive()
    assert found.success, found.summary()
    assert list_phase_names(found)[:3] == ["go to", "reach drawer.handle", "move drawer.slide"]
    assert set(list_phase_names(found)[3:]) == {"go to"}
    last = found.trajectory.positions[-1]
    np.testing.assert_allclose(last[:2], [-1.0, 1.0], atol=1e-3)
    assert found.trajectory.column("drawer.slide")[-1] == pytest.approx(0.15, abs=1e-3)
    arm = get_rows(found, len(list_phase_names(found)) - 1)[:, 3:]
    np.testing.assert_array_equal(arm, np.tile(arm[0], (len(arm), 1)))


@pytest.mark.parametrize("yaw", [None, 2.0, -2.0])
def test_drive(yaw: float | None) -> None:
    found = plan(make_open_scene(), vkc.GoTo(-1.0, 1.0, yaw))
    assert found.success, found.summary()
    assert list_phase_names(found) == ["go to"]
    assert np.ptp(found.trajectory.positions[:, 3:9], axis=0).max() == 0.0
    np.testing.assert_allclose(found.trajectory.positions[-1, :2], [-1.0, 1.0], atol=1e-3)
    if yaw is None:  # an omnidirectional base need not turn
        assert np.ptp(found.trajectory.positions[:, 2]) < 0.1
    else:
        assert np.cos(found.trajectory.positions[-1, 2] - yaw) == pytest.approx(1.0)


def test_no_base_path() -> None:
    scene = make_open_scene(describe_box("wall", [0.1, 4.6, 2.4], [0.15, 0.0, 1.2]))
    found = plan(scene, vkc.GoTo(1.0, 0.0))
    assert (found.success, found.status) == (False, "no base path")
    assert np.ptp(found.trajectory.positions[:, :3], axis=0).max() == 0.0, "it stands at its start"


def make_drive(scene: vkc.Scene) -> vkc.TrajectoryProblem:
    return make_program(scene, [vkc.GoTo(*scene.start[:3].tolist())], options=OPTIONS)


def test_postures_of_an_arm_at_home() -> None:
    scene = load_drawer_scene()
    first, second = generate_postures(make_drive(scene))
    assert len(first) == 0
    np.testing.assert_allclose(second[:, :3], [scene.start[:3]], atol=1e-12)
    assert np.abs(second[0, 3:] - scene.robot.home).max() > 0.5


def test_postures_after_a_release() -> None:
    scene = make_grasping_scene(make_open_scene())
    *_, back, home, compact = generate_postures(make_drive(scene))
    np.testing.assert_allclose(compact[:-1], home, atol=1e-12)
    assert len(back) == 1
    away = pin.SE3(np.eye(3), np.array([-vkc.Options().approach, 0.0, 0.0])) * compute_handle_pose()
    assert compute_pose_error(scene, back[0], away) < 1e-3
    np.testing.assert_allclose(back[0, :3], scene.start[:3], atol=1e-12)
    np.testing.assert_allclose(home[:-1], back, atol=1e-12)
    np.testing.assert_allclose(home[-1, 3:9], scene.robot.home, atol=1e-12)


def test_grasped_object_is_lifted_first() -> None:
    found = carry_cup()
    row = found.trajectory.positions[found.trajectory.phases[1].last]
    lifted = found.trajectory.positions[found.trajectory.phases[2].last]
    assert np.abs(lifted[:3] - row[:3]).max() < 1e-9
    low, high = (compute_placement(found, found.trajectory.phases[k].last) for k in (1, 2))
    np.testing.assert_allclose(
        high.translation - low.translation, [0.0, 0.0, vkc.Options().approach], atol=2e-3
    )
