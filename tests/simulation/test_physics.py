"""Tests the checks of physical settings and the completion of missing masses."""

from __future__ import annotations

import sys
from dataclasses import fields

import coal
import numpy as np
import pinocchio as pin
import pytest
from helpers.executions import make_grasping_scene, make_stationary_motion, plan_drawer

import vkc_pin as vkc
from vkc_pin.simulation.execution import simulate
from vkc_pin.simulation.physics import complete_inertias, import_mujoco
from vkc_pin.world.trajectory.world_model import World


def test_missing_mujoco_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = plan_drawer()
    monkeypatch.setitem(sys.modules, "mujoco", None)
    for call in (import_mujoco, plan.simulate):
        with pytest.raises(vkc.InputError, match="mujoco") as caught:
            call()
        assert caught.value.expected.startswith('pip install "mujoco')


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("timestep", 0.0),
        ("timestep", 0.05),
        ("friction", -1.0),
        ("grasp_force", float("nan")),
        ("balanced", 1),
        ("timestep", 1e-9),
        ("grip_time", 0.0),
        *((item.name, 1e9 * 1.1) for item in fields(vkc.Physics) if item.name != "balanced"),
    ],
)
def test_out_of_range_setting_is_named(name: str, value: object) -> None:
    with pytest.raises(vkc.InputError) as caught:
        vkc.Physics(**{name: value})
    assert caught.value.field == f"Physics.{name}"


def test_impossible_inertia_is_corrected_with_a_note() -> None:
    world = World(make_grasping_scene())
    joint = world.model.getJointId("stick.placement")
    world.model.inertias[joint] = pin.Inertia(1.0, np.zeros(3), np.diag([0.01, 0.01, 0.04]))
    (note,) = complete_inertias(world, vkc.Physics())
    np.testing.assert_allclose(
        np.asarray(world.model.inertias[joint].inertia), np.diag([0.03, 0.03, 0.06]), rtol=1e-4
    )
    assert "stick.placement" in note
    assert "50 %" in note


def test_missing_mass_is_estimated_from_volume_with_a_note() -> None:
    world = World(make_grasping_scene())
    joint = world.model.getJointId("base")
    world.model.inertias[joint] = pin.Inertia.Zero()
    (note,) = complete_inertias(world, vkc.Physics(density=500.0))
    solids = [shape for shape in world.bodies.geometryObjects if shape.parentJoint == joint]
    volume = sum(shape.geometry.computeVolume() for shape in solids)
    assert any(isinstance(shape.geometry, coal.ShapeBase) for shape in solids)
    assert world.model.inertias[joint].mass == pytest.approx(500.0 * volume, rel=0.02)
    assert "base" in note
    assert "500 kg/m³" in note


def test_resting_stick_does_not_roll() -> None:
    """A stick that rests on the rims of two discs stays where it is, with any version of MuJoCo."""
    scene = vkc.load_scene("init_1")
    motion = make_stationary_motion(scene, 4.0)
    x, y, yaw = scene.start[:3].tolist()
    result = simulate(scene, [vkc.GoTo(x, y, yaw)], motion)
    before = scene.objects["stick"].placement
    after = World(scene).get_placement("stick", result.rows[-1])
    off = pin.log6(before.actInv(after)).vector
    assert np.abs(off[:3]).max() < 2e-3
    assert np.abs(off[3:]).max() < 2e-3
