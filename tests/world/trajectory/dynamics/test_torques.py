"""Tests the torques of the arm against changes of energy and weights."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from helpers.door_closers import replace_object_fields

import vkc_pin as vkc
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.torques import Torques
from vkc_pin.world.trajectory.trajectory import PhaseSpan, Trajectory
from vkc_pin.world.trajectory.world_model import World


def make_swing(mass: float, *, base: float = 0.0) -> tuple[vkc.Scene, Trajectory]:
    """Return a scene with the stick in the hand, and a motion of arm and base in it."""
    scene = replace_object_fields(vkc.load_scene("init_1"), "stick", mass=mass).with_held(
        {"stick": "grip"}
    )
    names = (*scene.robot.coordinates.names, "stick.grip_slide", "stick.grip_turn")
    times, rng = np.linspace(0.0, 1.5, 6), np.random.default_rng(3)
    size = len(scene.start)
    positions = np.tile([*scene.start, *scene.holds[0].at], (6, 1))
    scale = np.array([base] * 3 + [0.5] * (size - 3))
    positions[:, :size] += scale * np.cumsum(rng.uniform(-1.0, 1.0, (6, size)), axis=0)
    rates = np.zeros_like(positions)
    rates[1:-1, :size] = scale * rng.uniform(-1.0, 1.0, (4, size))
    phase = PhaseSpan("swing", 0, 5, scene.holds)
    return scene, Trajectory(
        names, times, positions, (phase,), size, Curve(times, positions, rates)
    )


def compute_energy(world: World, motion: Trajectory, time: float) -> float:
    """Return the energy of robot and stick [J], from finite differences of body placements."""
    h = 1e-5
    rows = world.coordinates.q(
        world.compute_positions(motion, np.array([time - h, time, time + h]))
    )
    energy, placements = 0.0, []
    for q in rows:
        data = world.model.createData()
        pin.forwardKinematics(world.model, data, q)
        placements.append([data.oMi[j].copy() for j in range(world.model.njoints)])
    for j in range(2, world.model.njoints):
        inertia = world.model.inertias[j]
        speed = (placements[2][j] * inertia.lever - placements[0][j] * inertia.lever) / (2.0 * h)
        spin = pin.log3(placements[0][j].rotation.T @ placements[2][j].rotation) / (2.0 * h)
        energy += (
            0.5 * inertia.mass * speed @ speed + 0.5 * spin @ np.asarray(inertia.inertia) @ spin
        )
        energy += 9.81 * inertia.mass * (placements[1][j] * inertia.lever)[2]
    return energy


@pytest.mark.parametrize("mass", [0.0, 4.0])
def test_power_equals_the_change_of_energy(mass: float) -> None:
    scene, motion = make_swing(mass)
    world = World(scene)
    for time in (0.35, 0.8, 1.3):
        torques, rates = Torques(scene, motion).along(np.array([time])), motion.velocity(time)
        power = float(torques[0] @ rates[: motion.robot_size])
        change = (
            compute_energy(world, motion, time + 1e-3) - compute_energy(world, motion, time - 1e-3)
        ) / 2e-3
        assert power == pytest.approx(change, rel=2e-3, abs=2e-2)


def test_payload_at_rest_adds_its_weight() -> None:
    torques = []
    for mass in (0.0, 3.0):
        scene, motion = make_swing(mass)
        still = np.zeros_like(motion.positions[:1])
        torques.append(
            Torques(scene, motion).at(np.zeros(1, int), motion.positions[:1], still, still)[0]
        )
    world = World(scene)
    (q,) = world.coordinates.q(world.compute_positions(motion, motion.times[:1]))
    data = world.model.createData()
    jacobian = pin.computeJointJacobians(world.model, data, q)[:, : motion.robot_size]
    pin.forwardKinematics(world.model, data, q)
    joint = world.model.getJointId("stick.placement")
    center = data.oMi[joint] * world.model.inertias[joint].lever
    axes, expected = jacobian.T, []
    for twist in axes[3:]:
        expected.append(3.0 * 9.81 * (twist[:3] + np.cross(twist[3:], center))[2])
    np.testing.assert_allclose(torques[1][3:] - torques[0][3:], expected, atol=1e-6)


def test_base_acceleration_loads_the_arm() -> None:
    scene, motion = make_swing(2.0, base=0.4)
    _, still = make_swing(2.0)
    times = np.array([0.4, 0.9])
    assert (
        np.abs(Torques(scene, motion).along(times) - Torques(scene, still).along(times))[
            :, 3:
        ].max()
        > 0.5
    )
    assert not Torques(scene, motion).along(times)[:, :3].any()
