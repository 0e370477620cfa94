"""Servos are as strong as their joints, and follow where the plan goes at its speed."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest
from helpers.executions import door_plan, still
from helpers.telescopes import coupled_scene

import vkc_pin as vkc
from vkc_pin.simulation.contacts import touching_pairs
from vkc_pin.simulation.model import Builder
from vkc_pin.simulation.physics import Physics, weigh
from vkc_pin.simulation.servos import efforts_for, finger_rows, reference, servos
from vkc_pin.world.trajectory.world_model import World


def test_servos_are_made_for_the_inertia_that_they_move() -> None:
    plan = door_plan()
    world = World(plan.scene)
    own = servos(world, world.positions(plan.trajectory), Physics())
    assert [servo.coordinate for servo in own] == list(plan.scene.robot.coordinates.names)
    assert own[0].stiffness == pytest.approx(
        20.0**2 * sum(i.mass for i in plan.scene.robot.model.inertias[1:]), rel=1e-6
    )
    assert [servo.limit for servo in own] == [np.inf] * 3 + [150.0] * 3 + [28.0] * 3
    for servo in own[3:]:
        assert servo.stiffness * 0.05 >= servo.limit * (1.0 - 1e-9)
        assert servo.armature == pytest.approx(servo.limit / 1500.0)


def test_the_reference_is_the_plan_with_its_velocity() -> None:
    motion = door_plan().trajectory
    middles = (motion.times[:-1] + motion.times[1:]) / 2.0
    positions, velocities, accelerations = reference(motion, middles)
    np.testing.assert_allclose(accelerations, motion.acceleration(middles)[:, : motion.robot_size])
    np.testing.assert_allclose(positions, motion.at(middles)[:, : motion.robot_size])
    np.testing.assert_allclose(
        velocities, motion.velocity(middles)[:, : motion.robot_size], atol=1e-9
    )
    straight = dataclasses.replace(motion, curve=None)
    _, steady, none = reference(straight, middles)
    assert not none.any()
    np.testing.assert_allclose(steady, motion.velocities()[:, : motion.robot_size], atol=1e-9)
    _, outside, _ = reference(motion, np.array([motion.times[0] - 1.0, motion.times[-1] + 1.0]))
    assert not outside.any()


def test_a_hand_without_fingers_that_open_has_none_to_follow() -> None:
    plan = door_plan()
    world = World(plan.scene)
    rows = world.positions(plan.trajectory)
    assert finger_rows(world, rows, plan.trajectory.times, np.zeros(4)).shape == (4, 0)


@pytest.mark.parametrize("name", ["door", "coupled"])
def test_efforts_are_what_mujoco_needs_for_the_same_motion(name: str, tmp_path: Path) -> None:
    """By its inverse dynamics, of independent joints, of which one motor may move several."""
    scene = coupled_scene(tmp_path) if name == "coupled" else vkc.load_scene(name)
    world, physics, robot = World(scene), Physics(), scene.robot.coordinates
    weigh(world, physics)
    driven = servos(world, world.positions(still(scene)), physics)
    physical = Builder(world, physics).built(touching_pairs(world, ()), driven, (), ())
    rng, count = np.random.default_rng(3), 6
    rows = np.tile(world.start, (count, 1))
    rows[:, : robot.size] += rng.uniform(-1.0, 1.0, (count, robot.size))
    velocities, accelerations = rng.uniform(-2.0, 2.0, (2, count, robot.size))
    motion = rows[:, : robot.size], velocities, accelerations
    found = efforts_for(world, driven, rows[:, : len(driven)], motion)
    model = physical.model
    model.opt.gravity[:], data = 0.0, mujoco.MjData(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    slopes = np.zeros((model.nv, robot.size))
    for move in robot.moves:
        own = model.body_dofadr[physical.bodies[move.joint]] + (
            move.coordinate if move.coordinate < 3 else 0
        )
        slopes[own, move.coordinate] = move.factor
    for row, v, a, efforts in zip(rows, velocities, accelerations, found, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = physical.qpos(row), slopes @ v, slopes @ a
        mujoco.mj_inverse(model, data)
        np.testing.assert_allclose(efforts[: robot.size], slopes.T @ data.qfrc_inverse, atol=1e-6)
