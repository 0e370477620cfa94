"""Tests that the baselines carry a cup between tables, and keep the arm posture on drives."""

from __future__ import annotations

from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import describe_box
from helpers.drawers import (
    compute_handle_pose,
    compute_pose_error,
    load_drawer_scene,
    make_drawer_scene,
    make_grasping_scene,
    replace_scene_fields,
)
from helpers.drives import make_hall
from helpers.small_problems import make_program

import vkc_pin as vkc
from vkc_pin.experiments.baselines import plan_separately
from vkc_pin.experiments.baselines.postures import generate_postures
from vkc_pin.world.trajectory.world_model import World

OPTIONS = vkc.Options(reach_waypoints=20, move_waypoints=15)
CUP = (1.5, 0.1, 0.501)  # on a table in front of the robot
GOAL = (-0.2, 1.7, 0.701)  # on a table to its left
CARRY = vkc.Place("cup", GOAL)
CARRIED = ["go to", "reach cup.side", "go to", "go to", "place cup", "let go"]
"""Phases: drive, reach, retreat, drive, put down."""
PULL = vkc.Actuate("drawer", {"slide": 0.15})


def make_room() -> vkc.Scene:
    """Return a hall with two tables, and a cup on one of them."""
    tables = [
        describe_box("table", [0.6, 0.8, 0.02], [1.7, 0.1, 0.49]),
        describe_box("other", [0.8, 0.6, 0.02], [-0.2, 1.9, 0.69]),
    ]
    cup = {"name": "cup", "type": "cup", "position": list(CUP), "yaw": 0.4}
    return replace_scene_fields(make_hall(obstacles=tables), objects=[cup])


def plan_steps(scene: vkc.Scene, *steps: vkc.steps.Step) -> vkc.Plan:
    plan = plan_separately(scene, steps, options=OPTIONS, retries=1)
    assert plan.success, plan.summary()
    return plan


@cache
def carry_cup() -> vkc.Plan:
    return plan_steps(make_room(), CARRY)


def list_phase_names(plan: vkc.Plan) -> list[str]:
    return [phase.name for phase in plan.trajectory.phases]


def get_rows(plan: vkc.Plan, phase: int) -> np.ndarray:
    """Return the waypoints of a phase, the robot's columns."""
    span = plan.trajectory.phases[phase]
    return np.array(
        plan.trajectory.positions[span.first : span.last + 1, : plan.trajectory.robot_size]
    )


def compute_placement(plan: vkc.Plan, waypoint: int, name: str = "cup") -> pin.SE3:
    """Return the placement of an object at a waypoint, by the world model of validation."""
    world = World(plan.scene)
    return world.get_placement(name, world.compute_positions(plan.trajectory)[waypoint])


def test_cup_is_carried_from_table_to_table() -> None:
    plan = carry_cup()
    assert list_phase_names(plan) == CARRIED
    held = [dict(phase.held) for phase in plan.trajectory.phases]
    assert held == [{}, {}, *[{"cup": "side"}] * 3, {}]
    end = compute_placement(plan, -1)
    np.testing.assert_allclose(end.translation, GOAL, atol=1e-3)
    assert end.rotation[2, 2] > np.cos(1e-3), "the cup stands upright"


def test_object_grasped_at_the_start_is_placed() -> None:
    motion = carry_cup().trajectory
    *robot, turn, slide = motion.positions[motion.phases[3].first].tolist()
    assert motion.names[-2:] == ("cup.side_turn", "cup.side_slide")
    scene = make_room().with_start(base=robot[:3], arm=robot[3:])
    held = scene.with_held({"cup": "side"}, at={"cup": [slide, turn]})
    assert list_phase_names(plan_steps(held, CARRY)) == ["go to", "place cup", "let go"]


def test_drive_after_an_actuation_keeps_object_and_arm() -> None:
    plan = plan_steps(make_drawer_scene(), PULL, vkc.GoTo(-1.0, 1.0))
    assert list_phase_names(plan)[:3] == ["go to", "reach drawer.handle", "move drawer.slide"]
    assert set(list_phase_names(plan)[3:]) == {"go to"}
    assert plan.trajectory.column("drawer.slide")[-1] == pytest.approx(0.15, abs=1e-3)
    assert np.ptp(get_rows(plan, -1)[:, 3:], axis=0).max() == 0.0


@pytest.mark.parametrize("yaw", [None, 2.0])
def test_drive_keeps_the_arm_posture(yaw: float | None) -> None:
    plan = plan_steps(make_drawer_scene(), vkc.GoTo(-1.0, 1.0, yaw))
    assert list_phase_names(plan) == ["go to"]
    assert np.ptp(plan.trajectory.positions[:, 3:9], axis=0).max() == 0.0
    if yaw is None:  # an omnidirectional base need not turn
        assert np.ptp(plan.trajectory.positions[:, 2]) < 0.1


def test_wall_blocks_the_base_path() -> None:
    scene = make_drawer_scene(describe_box("wall", [0.1, 4.6, 2.4], [0.15, 0.0, 1.2]))
    plan = plan_separately(scene, [vkc.GoTo(1.0, 0.0)], options=OPTIONS, retries=1)
    assert (plan.success, plan.status) == (False, "no base path")
    assert np.ptp(plan.trajectory.positions[:, :3], axis=0).max() == 0.0


def make_drive(scene: vkc.Scene) -> vkc.TrajectoryProblem:
    return make_program(scene, [vkc.GoTo(*scene.start[:3].tolist())], options=OPTIONS)


def test_arm_at_home_has_one_other_posture() -> None:
    scene = load_drawer_scene()
    first, second = generate_postures(make_drive(scene))
    assert len(first) == 0
    np.testing.assert_allclose(second[:, :3], [scene.start[:3]], atol=1e-12)
    assert np.abs(second[0, 3:] - scene.robot.home).max() > 0.5


def test_arm_retreats_from_the_handle_after_a_release() -> None:
    scene = make_grasping_scene(make_drawer_scene())
    *_, back, home, compact = generate_postures(make_drive(scene))
    np.testing.assert_allclose(compact[:-1], home, atol=1e-12)
    (row,) = back
    away = pin.SE3(np.eye(3), np.array([-vkc.Options().approach, 0.0, 0.0])) * compute_handle_pose()
    assert compute_pose_error(scene, row, away) < 1e-3
    np.testing.assert_allclose(row[:3], scene.start[:3], atol=1e-12)
    np.testing.assert_allclose(home[:-1], back, atol=1e-12)
    np.testing.assert_allclose(home[-1, 3:9], scene.robot.home, atol=1e-12)


def test_grasped_object_is_lifted_first() -> None:
    plan = carry_cup()
    low, high = (compute_placement(plan, plan.trajectory.phases[k].last) for k in (1, 2))
    lift = [0.0, 0.0, vkc.Options().approach]
    np.testing.assert_allclose(high.translation - low.translation, lift, atol=2e-3)
