"""Tests that the MuJoCo model has the kinematics, masses and shapes of the kinematic tree."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import make_room
from helpers.executions import make_stationary_motion, plan_drawer
from helpers.telescopes import write_coupled_scene

import vkc_pin as vkc
from vkc_pin.simulation.contacts import find_contact_pairs
from vkc_pin.simulation.model import Builder, PhysicalWorld
from vkc_pin.simulation.physics import Physics, complete_inertias
from vkc_pin.simulation.result import SimulationResult
from vkc_pin.simulation.servos import make_servos
from vkc_pin.simulation.welds import find_latches
from vkc_pin.world.models.dynamics import Resistance
from vkc_pin.world.models.shapes import triangulate
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.world_model import World


def build_model(scene: Scene, *, has_notes: bool = False) -> PhysicalWorld:
    physics, world, holds = Physics(), World(scene), scene.holds
    assert bool(complete_inertias(world, physics)) == has_notes
    driven = make_servos(world, world.compute_positions(make_stationary_motion(scene)), physics)
    latches = [(joint, at) for joint, at, _, _ in find_latches(scene)]
    return Builder(world, physics).build(find_contact_pairs(world, holds), driven, holds, latches)


def sample_rows(world: World, count: int) -> np.ndarray:
    rows = world.start + np.random.default_rng(1).uniform(
        -2.0, 2.0, (count, world.coordinates.size)
    )
    for name, placed in world.scene.objects.items():
        if placed.object.free:
            columns = world.get_placement_columns(name)
            quaternions = rows[:, columns.start + 3 : columns.stop]
            quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return rows


@pytest.mark.parametrize("name", ["door", "household", "coupled"])
def test_placements_agree_with_pinocchio(name: str, tmp_path: Path) -> None:
    coupled = name == "coupled"
    scene = write_coupled_scene(tmp_path) if coupled else vkc.load_scene(name)
    physical = build_model(scene, has_notes=coupled)
    world, model = physical.world, physical.model
    data, tree = mujoco.MjData(model), world.model.createData()
    for row in sample_rows(world, 5):
        data.qpos[:] = physical.to_qpos(row)
        mujoco.mj_kinematics(model, data)
        pin.forwardKinematics(world.model, tree, world.coordinates.q(row))
        for joint in range(1, world.model.njoints):
            body = physical.bodies[joint]
            np.testing.assert_allclose(data.xpos[body], tree.oMi[joint].translation, atol=1e-9)
            np.testing.assert_allclose(
                data.xmat[body].reshape(3, 3), tree.oMi[joint].rotation, atol=1e-9
            )
        np.testing.assert_allclose(physical.from_qpos(data.qpos), row, atol=1e-12)
        for number, shape in enumerate(world.shapes):
            geom = int(physical.geoms[number])
            expected = (
                tree.oMi[shape.parentJoint] * shape.placement
                if shape.parentJoint
                else shape.placement
            )
            place, rotation = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
            if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_MESH:
                np.testing.assert_allclose(place, expected.translation, atol=1e-9)
                continue
            mesh = int(model.geom_dataid[geom])  # MuJoCo turns meshes into their principal axes
            first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
            vertices = model.mesh_vert[first : first + count] @ rotation.T + place
            points = triangulate(shape.geometry)[0] @ expected.rotation.T + expected.translation
            np.testing.assert_allclose(vertices.min(axis=0), points.min(axis=0), atol=1e-5)
            np.testing.assert_allclose(vertices.max(axis=0), points.max(axis=0), atol=1e-5)


def test_masses_agree_with_pinocchio() -> None:
    physical = build_model(vkc.load_scene("household"))
    tree = World(physical.world.scene).model  # with the inertias of the files
    for joint in range(1, tree.njoints):
        inertia, body = tree.inertias[joint], int(physical.bodies[joint])
        assert physical.model.body_mass[body] == pytest.approx(inertia.mass)
        np.testing.assert_allclose(physical.model.body_ipos[body], inertia.lever, atol=1e-9)
        principal = np.sort(np.linalg.eigvalsh(np.asarray(inertia.inertia)))
        # The cabinet's inertias are rounded.
        principal += max(0.0, principal[2] - principal[0] - principal[1])
        np.testing.assert_allclose(np.sort(physical.model.body_inertia[body]), principal, rtol=1e-3)


def test_ball_on_the_floor_comes_to_rest() -> None:
    """Rolling friction decelerates a hollow ball at 0.17 m/s²."""
    physical = build_model(make_room(objects=("ball",)))
    model, data = physical.model, mujoco.MjData(physical.model)
    data.qpos[:] = physical.to_qpos(physical.world.start)
    position = physical.columns[physical.world.get_placement_columns("ball")][:3]
    data.qpos[position] = [3.0, 0.0, 0.035]
    velocity = data.qvel[-6:]  # of the only free joint
    velocity[:] = [0.1, 0.0, 0.0, 0.0, 0.1 / 0.035, 0.0]
    mujoco.mj_step(model, data, round(1.0 / model.opt.timestep))
    assert np.abs(velocity).max() < 1e-3
    assert 0.02 < data.qpos[position[0]] - 3.0 < 0.04


def test_objects_have_the_described_joint_resistance() -> None:
    """Joint friction adds to the pulling force, and a spring pulls the drawer back."""
    plan = plan_drawer()
    placed = plan.scene.objects["drawer"]

    def simulate_with(**resistance: float) -> SimulationResult:
        resistances = {"slide": Resistance(**resistance)}
        changed = dataclasses.replace(
            placed, object=dataclasses.replace(placed.object, resistance=resistances)
        )
        actual = dataclasses.replace(plan.scene, objects={**plan.scene.objects, "drawer": changed})
        return plan.simulate(actual=actual)

    plain, rough = simulate_with(), simulate_with(friction=40.0)
    assert rough.grips[0].force - plain.grips[0].force == pytest.approx(40.0, rel=0.15)
    sprung = simulate_with(stiffness=100.0, springref=0.0)
    assert sprung.grips[0].force > plain.grips[0].force + 10.0
