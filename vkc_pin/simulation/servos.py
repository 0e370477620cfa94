"""Defines the position servos of base, arm and fingers, and the reference that they track."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.simulation.physics import Physics
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.trajectory.torques import transform_to_base_axes
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.wheels import rotate_into_base_frame
from vkc_pin.world.trajectory.world_model import World

_UNLIMITED = 1e300  # Pinocchio's effort limits above this mean none
# [s²] The effort limit accelerates a joint's own rotor by 1500 rad/s²: 0.1 kg·m² at 150 N·m.
_ROTOR_INERTIA_PER_EFFORT = 1.0 / 1500.0
_SAG = {"rad": 0.05, "m": 0.005}  # largest deflection under a load of full effort
_ROTOR_INERTIA_RATIO = 0.05  # rotor to load inertia, for joints without an effort limit
_SAMPLES = 40  # configurations of the plan at which inertias are computed
_DIFFERENCE = 0.01  # [s] interval of finite differences for velocities


@dataclass(frozen=True)
class Servo:
    """A position servo with feed-forward.

    Its force is stiffness · (z − actual) + damping · (ż − actual velocity) + the torque for z̈.

    Attributes:
        coordinate: Name of the driven coordinate in the world.
        stiffness: Stiffness [N·m/rad] or [N/m].
        damping: Damping [N·m·s/rad] or [N·s/m].
        inertia: Largest inertia that it moves, including its rotor's [kg·m²] or [kg].
        armature: Inertia of the rotor, reflected to the joint [kg·m²] or [kg].
        limit: Largest force, including compensation of the robot's own weight [N·m] or [N];
            infinite if none is stated.
    """

    coordinate: str
    stiffness: float
    damping: float
    inertia: float
    armature: float
    limit: float

    def configure_joint(self, joint: Any, mj: Any) -> None:
        """Set the rotor inertia and force limit of a joint of a `mujoco.MjSpec`."""
        joint.armature, joint.actgravcomp = self.armature, True
        if np.isfinite(self.limit):
            joint.actfrclimited = mj.mjtLimited.mjLIMITED_TRUE
            joint.actfrcrange = [-self.limit, self.limit]

    def add_to(self, spec: Any, mj: Any) -> None:
        """Add the servo to a `mujoco.MjSpec` that contains its joint."""
        actuator = spec.add_actuator(
            name=self.coordinate, target=self.coordinate, trntype=mj.mjtTrn.mjTRN_JOINT
        )
        actuator.gaintype, actuator.biastype = mj.mjtGain.mjGAIN_FIXED, mj.mjtBias.mjBIAS_AFFINE
        actuator.gainprm[0] = self.stiffness
        actuator.biasprm[:3] = [0.0, -self.stiffness, -self.damping]


def make_servos(world: World, rows: Floats, physics: Physics) -> tuple[Servo, ...]:
    """Return the robot's servos in the order of the world's coordinates: base, arm, fingers.

    Args:
        world: The scene.
        rows: World coordinates along the plan, shape (K, n); each servo is designed for the largest
            inertia that it moves there.
        physics: Bandwidths and damping.
    """
    model, data, robot = world.model, world.model.createData(), world.scene.robot
    count = len(world.scene.start) + (0 if robot.gripper is None else len(robot.gripper.names))
    inertias = np.zeros(model.nv)
    for q in world.coordinates.q(rows[:: max(1, len(rows) // _SAMPLES)]):
        inertias = np.maximum(inertias, np.diag(pin.crba(model, data, q)))
    result = []
    for k, name in enumerate(world.coordinates.names[:count]):
        velocity = model.joints[world.coordinates.joints[k]].idx_v + (k if k < 3 else 0)
        stated, load_inertia = float(model.effortLimit[velocity]), float(inertias[velocity])
        limit = stated if 0.0 < stated < _UNLIMITED and k > 2 else np.inf
        bandwidth = physics.base_bandwidth if k < 3 else physics.arm_bandwidth
        unit = world.coordinates.units[k]
        result.append(
            make_servo(
                name, load_inertia, limit, unit, bandwidth, physics.damping_ratio, has_rotor=k > 2
            )
        )
    return tuple(result)


def make_servo(
    coordinate: str,
    load_inertia: float,
    limit: float,
    unit: str,
    bandwidth: float,
    damping_ratio: float,
    *,
    has_rotor: bool = True,
) -> Servo:
    """Design a servo.

    Args:
        coordinate: Driven coordinate.
        load_inertia: Largest inertia that it moves, without the rotor [kg·m²] or [kg].
        limit: Force limit [N·m] or [N]; infinite if there is none.
        unit: Unit of the coordinate, "rad" or "m".
        bandwidth: Natural frequency at that inertia [rad/s].
        damping_ratio: Damping ratio.
        has_rotor: Whether its motor has a rotor.
    """
    armature = (
        0.0
        if not has_rotor
        else limit * _ROTOR_INERTIA_PER_EFFORT
        if np.isfinite(limit)
        else _ROTOR_INERTIA_RATIO * load_inertia
    )
    inertia = load_inertia + armature
    stiffness = inertia * bandwidth**2
    if np.isfinite(limit):
        stiffness = max(stiffness, limit / _SAG[unit])
    return Servo(
        coordinate,
        stiffness,
        2.0 * damping_ratio * float(np.sqrt(stiffness * inertia)),
        inertia,
        armature,
        limit,
    )


def sample_reference(trajectory: Trajectory, times: Floats) -> tuple[Floats, Floats, Floats]:
    """Return positions, velocities and accelerations of the robot, shape (K, robot's) each.

    Without a curve, velocities are discontinuous and accelerations are zero.
    """
    robot = slice(0, trajectory.robot_size)
    if trajectory.curve is not None:
        read = trajectory.at, trajectory.velocity, trajectory.acceleration
        positions, velocities, accelerations = (values(times)[:, robot] for values in read)
        return positions, velocities, accelerations
    later, earlier = (
        trajectory.at(times + shift)[:, robot] for shift in (_DIFFERENCE / 2.0, -_DIFFERENCE / 2.0)
    )
    return trajectory.at(times)[:, robot], (later - earlier) / _DIFFERENCE, np.zeros_like(later)


def compute_feedforward(
    world: World, servos: Sequence[Servo], rows: Floats, motion: tuple[Floats, Floats, Floats]
) -> Floats:
    """Return the motor torques for a motion of base and arm, shape (K, servos) [N·m], [N].

    They follow from the inverse dynamics of the robot and its rotors, as in a computed-torque
    controller. The robot's weight is left out, since the motors compensate it anyway. Grasped
    objects are unknown to the controller.

    Args:
        world: The scene, all of whose bodies have masses.
        servos: Servos of base, arm and fingers, one per column of `rows`.
        rows: Their positions, shape (K, servos).
        motion: Positions, velocities and accelerations of base and arm, shape (K, robot's) each.
    """
    robot, size = world.scene.robot, motion[0].shape[1]
    model = pin.Model(robot.model if robot.gripper is None else robot.gripper.model)
    model.gravity = pin.Motion.Zero()
    for joint in range(1, model.njoints):
        model.inertias[joint] = world.model.inertias[joint]
    velocities, accelerations = (
        np.pad(part, ((0, 0), (0, rows.shape[1] - size))) for part in motion[1:]
    )
    rotor_torques = accelerations * [servo.armature for servo in servos]
    v, a = transform_to_base_axes(rows[:, 2], velocities, accelerations)
    data = model.createData()
    torques = np.array(
        [
            pin.rnea(model, data, *state)
            for state in zip(Coordinates(model).q(rows), v, a, strict=True)
        ]
    )
    # The servos act along the world's axes.
    torques[:, :2] = np.transpose(rotate_into_base_frame(torques[:, 0], torques[:, 1], -rows[:, 2]))
    return rotor_torques + torques


def sample_fingers(world: World, rows: Floats, row_times: Floats, times: Floats) -> Floats:
    """Interpolate the finger positions at times [s], shape (K,): shape (K, fingers).

    Args:
        world: The scene.
        rows: World coordinates at the times `row_times`.
        row_times: Their times [s].
        times: Sampling times, shape (K,) [s].
    """
    first = len(world.scene.start)
    gripper = world.scene.robot.gripper
    columns: Sequence[int] = range(first, first + (0 if gripper is None else len(gripper.names)))
    return np.column_stack(
        [np.zeros((len(times), 0)), *(np.interp(times, row_times, rows[:, k]) for k in columns)]
    )
