"""Tests wrenches and torques against closed forms, virtual work, and changes of energy."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from helpers.door_closers import load_door_with_closer, replace_object_fields
from hypothesis import given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.torques import Handle, Motion, Torques
from vkc_pin.world.trajectory.world_model import World

REAL = st.floats(-1.0, 1.0)


def make_motion(**coordinates: tuple[float, float, float]) -> Motion:
    """Return a single sample; coordinate (`_` for `.`) → position, velocity, acceleration."""
    parts = (
        {name.replace("_", ".", 1): np.array([row[k]]) for name, row in coordinates.items()}
        for k in range(3)
    )
    return Motion(*parts)


def load_drawer(**resistance: float) -> vkc.Scene:
    return replace_object_fields(vkc.load_scene("drawer"), "drawer", joints={"slide": resistance})


@pytest.mark.parametrize("payload", [0.0, 2.5])
@pytest.mark.parametrize("velocity", [0.3, -0.3, 0.0])
def test_drawer_needs_a_force_along_its_slide(payload: float, velocity: float) -> None:
    scene = load_drawer(friction=8.0, damping=20.0, stiffness=50.0, springref=-0.1)
    handle = Handle(
        scene,
        vkc.Hold("drawer", "handle"),
        [(1, pin.Inertia(payload, np.zeros(3), np.zeros((3, 3))))],
    )
    (wrench,) = handle.wrenches(make_motion(drawer_slide=(0.2, velocity, 0.5)))
    dissipative = 8.0 * np.sign(velocity) + 20.0 * velocity
    expected = dissipative + 50.0 * 0.3 + (5.0 + payload) * 0.5
    placed = scene.objects["drawer"]
    positions = (placed.object.link_placement("tray", [value]).translation for value in (1.0, 0.0))
    direction = placed.placement.rotation @ np.subtract(*positions)
    np.testing.assert_allclose(wrench, [*(expected * direction), 0.0, 0.0, 0.0], atol=1e-9)


def test_hand_lifts_loads_but_not_the_object_itself() -> None:
    """Springs carry the object; its slide is inclined here."""
    scene = vkc.load_scene("drawer")
    placed = scene.objects["drawer"]
    tilted = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.4, 0.5), placed.placement.translation)
    placed = dataclasses.replace(placed, placement=tilted)
    scene = dataclasses.replace(scene, objects={**scene.objects, "drawer": placed})
    positions = (placed.object.link_placement("tray", [value]).translation for value in (1.0, 0.0))
    slope = float((tilted.rotation @ np.subtract(*positions))[2])
    assert abs(slope) > 0.2
    for payload in (0.0, 2.5):
        loads = [(1, pin.Inertia(payload, np.zeros(3), np.zeros((3, 3))))] * (payload > 0.0)
        handle = Handle(scene, vkc.Hold("drawer", "handle"), loads)
        (force,) = handle.forces(make_motion(drawer_slide=(0.2, 0.3, 0.5)))[0]
        assert force == pytest.approx((5.0 + payload) * 0.5 + payload * 9.81 * slope)
    dishwasher = Handle(vkc.load_scene("household"), vkc.Hold("dishwasher", "handle"))
    at_rest = make_motion(dishwasher_door=(0.5, 0.0, 0.0), dishwasher_rack=(0.0, 0.0, 0.0))
    np.testing.assert_array_equal(dishwasher.forces(at_rest), 0.0)


@cache
def load_heavy_door() -> vkc.Scene:
    return load_door_with_closer(stiffness=5.0, springref=-2.0, damping=3.0)


@pytest.mark.parametrize("attachment", ["handle", "handle_free", "push"])
@settings(max_examples=12, deadline=None)
@given(st.tuples(REAL, REAL, REAL), st.floats(0.05, 0.7), REAL, st.floats(-0.1, 0.1))
def test_wrench_does_the_work_of_the_joints_and_none_along_freedoms(
    attachment: str, hinge: tuple[float, float, float], knob: float, rate: float, turn: float
) -> None:
    placed = load_heavy_door().objects["door"]
    grasp = placed.object.attachment(attachment)
    rows = {f"door_{name}": (turn, 0.0, 0.0) for name in grasp.coordinates}
    motion = make_motion(door_hinge=hinge, door_knob=(knob, rate, 0.0), **rows)
    handle = Handle(load_heavy_door(), vkc.Hold("door", attachment))
    (wrench,), (force,) = handle.wrenches(motion), handle.forces(motion)

    def compute_tool_pose(values: np.ndarray) -> pin.SE3:
        link = placed.placement * placed.object.link_placement(grasp.link, values[:2])
        return link * grasp.tool([values[2], turn, turn][: len(grasp.coordinates)])

    def compute_work(column: int) -> float:
        shift = 1e-5 * np.eye(3)[column]
        more, less = (
            compute_tool_pose(np.array([hinge[0], knob, turn]) + sign * shift) for sign in (1, -1)
        )
        moved = more.translation - less.translation
        turned = pin.log3(more.rotation @ less.rotation.T)
        return float(wrench[:3] @ moved + wrench[3:] @ turned) / 2e-5

    assert compute_work(0) == pytest.approx(force[0], rel=1e-5, abs=1e-6)
    if attachment == "push":
        np.testing.assert_array_equal(wrench[3:], 0.0)
    else:
        assert compute_work(1) == pytest.approx(force[1], rel=1e-5, abs=1e-6)
    if attachment == "handle_free":
        assert compute_work(2) == pytest.approx(0.0, abs=1e-6)


def test_wrench_is_the_smallest_sufficient_one() -> None:
    door = load_door_with_closer(stiffness=5.0, springref=-2.0)
    handle = Handle(door, vkc.Hold("door", "handle"))
    (wrench,) = handle.wrenches(make_motion(door_hinge=(0.6, 0.2, 0.1), door_knob=(0.5, 0.0, 0.0)))
    force = float(np.linalg.norm(wrench[:3]))
    # It is the joint torque over the lever arm, plus the inertia of the panel.
    assert force == pytest.approx(13.0 / 0.74, rel=0.1)
    assert np.hypot(force, np.linalg.norm(wrench[3:]) / 0.1) == pytest.approx(force, rel=0.1)


def test_latches_and_joint_stops_carry_static_loads() -> None:
    shut = make_motion(door_hinge=(0.0, 0.0, 0.0), door_knob=(0.2, 0.5, 0.0))
    door = load_door_with_closer(stiffness=5.0, springref=-2.0)
    handle = Handle(door, vkc.Hold("door", "handle"))
    assert handle.forces(shut)[0, 0] == 0.0
    leaving = make_motion(door_hinge=(0.0, 0.0, 0.5), door_knob=(0.5, 0.0, 0.0))
    assert handle.forces(leaving)[0, 0] > 10.0
    slide = Handle(load_drawer(stiffness=50.0, springref=-1.0), vkc.Hold("drawer", "handle"))
    assert slide.forces(make_motion(drawer_slide=(0.0, 0.0, 0.0)))[0, 0] == 0.0
    assert slide.forces(make_motion(drawer_slide=(0.1, 0.0, 0.0)))[0, 0] == pytest.approx(55.0)


def make_swing(mass: float, *, base: float = 0.0) -> tuple[vkc.Scene, vkc.Trajectory]:
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
    phase = vkc.PhaseSpan("swing", 0, 5, scene.holds)
    return scene, vkc.Trajectory(
        names, times, positions, (phase,), size, Curve(times, positions, rates)
    )


def compute_energy(world: World, motion: vkc.Trajectory, time: float) -> float:
    """Return the energy of robot and stick [J], from finite differences of configurations."""
    h, model, data = 1e-5, world.model, world.model.createData()
    times = np.array([time - h, time, time + h])
    before, at, after = world.coordinates.q(world.compute_positions(motion, times))
    rates = pin.difference(model, before, after) / (2.0 * h)
    kinetic = pin.computeKineticEnergy(model, data, at, rates)
    return float(kinetic + pin.computePotentialEnergy(model, data, at))


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
    weight = np.array([0.0, 0.0, 3.0 * 9.81])
    expected = [weight @ (twist[:3] + np.cross(twist[3:], center)) for twist in jacobian.T[3:]]
    np.testing.assert_allclose(torques[1][3:] - torques[0][3:], expected, atol=1e-6)


def test_base_acceleration_loads_the_arm() -> None:
    scene, motion = make_swing(2.0, base=0.4)
    still, times = make_swing(2.0)[1], np.array([0.4, 0.9])
    moving, resting = (Torques(scene, one).along(times) for one in (motion, still))
    assert np.abs(moving - resting)[:, 3:].max() > 0.5
    assert not moving[:, :3].any()
