"""Tests fingers, and that friction grasps hold objects within the friction cone only."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.executions import (
    make_grasping_scene,
    make_stationary_motion,
    plan_drawer,
    simulate_drawer,
)
from helpers.fake_plan import make_fake_plan
from helpers.grippers import write_cheeks_scene, write_gripper

import vkc_pin as vkc
from vkc_pin.simulation.execution import simulate
from vkc_pin.simulation.friction import find_fingers, insert_pauses, limit_finger_servos
from vkc_pin.simulation.physics import Physics
from vkc_pin.simulation.servos import make_servos
from vkc_pin.world.trajectory.world_model import World


def test_pads_slide_without_a_described_gripper() -> None:
    world = World(vkc.load_scene("drawer"))
    fingers = find_fingers(world, Physics(closing_force=100.0))
    assert fingers.sides is not None
    # Half the opening in the robot's README.
    assert fingers.sides.travel == pytest.approx(0.043, abs=5e-4)
    # The pads, not the linkages behind them.
    names = [[world.collision_labels[k] for k in side] for side in fingers.sides.shapes]
    assert names == [["gripper_right_finger"], ["gripper_left_finger"]]
    assert [servo.limit for servo in fingers.servos] == [100.0, 100.0]


def test_described_gripper_uses_its_own_joints(tmp_path: Path) -> None:
    world = World(write_cheeks_scene(write_gripper(tmp_path), opening=0.03))
    fingers = find_fingers(world, Physics())
    assert (fingers.sides, fingers.names) == (None, ("finger_a_joint", "finger_b_joint"))
    np.testing.assert_allclose(fingers.closed, 0.0)
    np.testing.assert_allclose(fingers.open, 0.04)
    servos = make_servos(world, world.start[None], Physics())
    weak = limit_finger_servos(servos, fingers, world, Physics(closing_force=7.0))
    expected = {one.coordinate: one.limit for one in servos} | dict.fromkeys(fingers.names, 7.0)
    assert {one.coordinate: one.limit for one in weak} == expected


def test_hand_without_fingers_is_rejected() -> None:
    scene = vkc.load_scene("drawer")
    touch_links = frozenset({"gripper_link", "gripper_left_finger"})
    robot = dataclasses.replace(scene.robot, touch_links=touch_links)
    with pytest.raises(vkc.InputError, match="no fingers that close") as caught:
        find_fingers(World(dataclasses.replace(scene, robot=robot)), Physics())
    assert caught.value.field == "grasp"
    assert "gripper" in str(caught.value.expected)


def test_drawer_is_pulled_by_friction() -> None:
    plan = plan_drawer()
    result = plan.simulate(grasp="friction")
    assert result.ok, result.summary()
    assert result.contacts == ()
    (grip,) = result.grips
    assert grip.slip < 0.005
    # The pulling force is about that of a weld; the robot waits while the fingers close.
    welded = simulate_drawer().grips[0]
    assert 0.2 * welded.force < grip.force < 3.0 * welded.force
    assert result.planned.times[-1] == pytest.approx(
        plan.trajectory.times[-1] + result.physics.grip_time
    )
    assert any("slide towards each other" in note for note in result.notes)


def test_slipping_object_is_lost() -> None:
    physics = vkc.Physics(closing_force=0.2)
    result = plan_drawer().simulate(grasp="friction", physics=physics)
    assert not result.ok
    assert result.grips[0].broken is not None
    assert result.grips[0].slip > 0.003  # until the pads lose contact
    assert any("drawer.slide" in line for line in result.problems())


@pytest.mark.long
def test_cup_is_carried_and_placed() -> None:
    plan = vkc.plan(vkc.load_scene("household"), [vkc.Place("cup", (-0.6, -1.6, 0.751))])
    result = plan.simulate(grasp="friction")
    assert result.ok, result.summary()
    (grip,) = result.grips
    assert grip.force > 0.25 * 9.81 * 0.9  # its weight at least
    # MuJoCo's default contacts creep on curves; see `Builder.has_friction_grasps`.
    assert grip.slip < 0.005
    assert max(miss.amount for miss in result.misses if miss.unit == "m") < 0.01


def test_described_gripper_closes_its_own_fingers(tmp_path: Path) -> None:
    scene = write_cheeks_scene(write_gripper(tmp_path), opening=0.03)
    result = vkc.plan(scene, [vkc.Actuate("drawer", {"slide": 0.15})]).simulate(grasp="friction")
    assert result.ok, result.summary()
    assert not any("slide towards" in note for note in result.notes)
    # Fingers close on the handle, 20 mm apart, and slightly further as contacts are compliant.
    finger_positions = result.rows[:, len(scene.start) : len(scene.start) + 2]
    assert finger_positions.min() == pytest.approx(0.01, abs=0.004)


def test_object_grasped_at_the_start_stays_in_the_hand() -> None:
    scene = make_grasping_scene()
    motion = make_stationary_motion(scene, 1.5)
    result = simulate(scene, [vkc.Grasp("stick")], motion, grasp="friction")
    (grip,) = result.grips
    assert grip.broken is None, result.summary()
    assert grip.force == pytest.approx(9.81 * 0.4, rel=0.3)
    assert result.misses[0].amount < 0.01


@pytest.mark.parametrize("make", [plan_drawer, make_fake_plan])
def test_pause_is_inserted_at_waypoint(make: Callable[[], vkc.Plan]) -> None:
    """The pause belongs to the phase that begins at the waypoint."""
    motion = make().trajectory
    at = motion.phases[1].first
    time, end = float(motion.times[at]), motion.times[-1]
    longer = insert_pauses(motion, [at, at], 0.5)
    assert len(longer.times) == len(motion.times) + 1
    assert longer.times[-1] == pytest.approx(end + 0.5)
    before, after = np.linspace(0.0, time - 1e-6, 50), np.linspace(time + 1e-6, end, 50)
    for method in ("at", "velocity", "acceleration"):
        one, other = getattr(longer, method), getattr(motion, method)
        np.testing.assert_allclose(one(before), other(before), atol=1e-9)
        np.testing.assert_allclose(one(after + 0.5), other(after), atol=1e-6)
    inside = time + np.linspace(1e-6, 0.5 - 1e-6, 20)
    np.testing.assert_allclose(longer.at(inside), np.tile(motion.at(time), (20, 1)), atol=1e-12)
    assert np.abs(longer.velocity(inside)).max() < 1e-9
    first, second = longer.phases[:2]
    assert (first.last, second.first, second.last) == (at, at, motion.phases[1].last + 1)
    assert [p.holds for p in longer.phases] == [p.holds for p in motion.phases]


def test_pause_during_motion_is_rejected() -> None:
    motion = plan_drawer().trajectory
    assert insert_pauses(motion, [], 0.25) is motion
    with pytest.raises(vkc.InputError, match="while the robot moves"):
        insert_pauses(motion, [motion.phases[0].last // 2], 0.5)
