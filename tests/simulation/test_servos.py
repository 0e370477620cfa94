"""Tests the reference and the feedforward of servos."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from helpers.executions import make_stationary_motion
from helpers.telescopes import write_coupled_scene

import vkc_pin as vkc
from vkc_pin.simulation.contacts import find_contact_pairs
from vkc_pin.simulation.model import Builder
from vkc_pin.simulation.physics import Physics, complete_inertias
from vkc_pin.simulation.servos import (
    compute_feedforward,
    make_servos,
)
from vkc_pin.world.trajectory.world_model import World


@pytest.mark.parametrize("name", ["door", "coupled"])
def test_feedforward_agrees_with_inverse_dynamics_of_mujoco(name: str, tmp_path: Path) -> None:
    """MuJoCo's joints are independent; one motor may move several of them."""
    scene = write_coupled_scene(tmp_path) if name == "coupled" else vkc.load_scene(name)
    world, physics, robot = World(scene), Physics(), scene.robot.coordinates
    complete_inertias(world, physics)
    driven = make_servos(world, world.compute_positions(make_stationary_motion(scene)), physics)
    physical = Builder(world, physics).build(find_contact_pairs(world, ()), driven, (), ())
    rng, count = np.random.default_rng(3), 6
    rows = np.tile(world.start, (count, 1))
    rows[:, : robot.size] += rng.uniform(-1.0, 1.0, (count, robot.size))
    velocities, accelerations = rng.uniform(-2.0, 2.0, (2, count, robot.size))
    motion = rows[:, : robot.size], velocities, accelerations
    found = compute_feedforward(world, driven, rows[:, : len(driven)], motion)
    model = physical.model
    model.opt.gravity[:], data = 0.0, mujoco.MjData(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    transmission = np.zeros((model.nv, robot.size))
    for move in robot.moves:
        dof = model.body_dofadr[physical.bodies[move.joint]]
        dof += move.coordinate if move.coordinate < 3 else 0
        transmission[dof, move.coordinate] = move.factor
    for row, v, a, torques in zip(rows, velocities, accelerations, found, strict=True):
        data.qpos[:], data.qvel[:] = physical.to_qpos(row), transmission @ v
        data.qacc[:] = transmission @ a
        mujoco.mj_inverse(model, data)
        expected = transmission.T @ data.qfrc_inverse
        np.testing.assert_allclose(torques[: robot.size], expected, atol=1e-6)
