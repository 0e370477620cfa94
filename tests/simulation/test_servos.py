"""Servos are as strong as their joints, and follow where the plan goes at its speed."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from helpers.executions import door_plan

from vkc_pin.motion.world import World
from vkc_pin.simulation.physics import Physics
from vkc_pin.simulation.servos import finger_rows, reference, servos


def test_servos_are_made_for_the_inertia_that_they_move() -> None:
    plan = door_plan()
    world = World(plan.scene)
    own = servos(world, world.positions(plan.trajectory), Physics())
    assert [servo.coordinate for servo in own] == list(plan.scene.robot.coordinates.names)
    assert own[0].stiffness == pytest.approx(20.0**2 * sum(i.mass for i in plan.scene.robot.model.inertias[1:]), rel=1e-6)
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
    np.testing.assert_allclose(velocities, motion.velocity(middles)[:, : motion.robot_size], atol=1e-9)
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
