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

# Pinocchio's effort limits above this mean none
_UNLIMITED = 1e300
# [s²] The effort limit accelerates a joint's own rotor by 1500 rad/s²: 0.1 kg·m² at 150 N·m.
_ROTOR_INERTIA_PER_EFFORT = 1.0 / 1500.0
# largest deflection under a load of full effort
_SAG = {"rad": 0.05, "m": 0.005}
# rotor to load inertia, for joints without an effort limit
_ROTOR_INERTIA_RATIO = 0.05
# configurations of the plan at which inertias are computed
_SAMPLES = 40
# [s] interval of finite differences for velocities
_DIFFERENCE = 0.01
# coordinates of the base: x, y, yaw
_BASE_SIZE = 3


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
        joint.armature = self.armature
        joint.actgravcomp = True
        if np.isfinite(self.limit):
            joint.actfrclimited = mj.mjtLimited.mjLIMITED_TRUE
            joint.actfrcrange = [-self.limit, self.limit]

    def add_to(self, spec: Any, mj: Any) -> None:
        """Add the servo to a `mujoco.MjSpec` that contains its joint."""
        actuator = spec.add_actuator(
            name=self.coordinate, target=self.coordinate, trntype=mj.mjtTrn.mjTRN_JOINT
        )
        actuator.gaintype = mj.mjtGain.mjGAIN_FIXED
        actuator.biastype = mj.mjtBias.mjBIAS_AFFINE
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
    model = world.model
    data = model.createData()
    coordinates = world.coordinates
    gripper = world.scene.robot.gripper
    finger_count = 0 if gripper is None else len(gripper.names)
    count = len(world.scene.start) + finger_count
    inertias = np.zeros(model.nv)
    stride = max(1, len(rows) // _SAMPLES)
    for q in coordinates.q(rows[::stride]):
        inertias = np.maximum(inertias, np.diag(pin.crba(model, data, q)))
    servos: list[Servo] = []
    for k, name in enumerate(coordinates.names[:count]):
        is_base = k < _BASE_SIZE
        # The base is one joint with three velocities.
        velocity = model.joints[coordinates.joints[k]].idx_v + (k if is_base else 0)
        effort_limit = float(model.effortLimit[velocity])
        is_limited = 0.0 < effort_limit < _UNLIMITED and not is_base
        servo = make_servo(
            name,
            float(inertias[velocity]),
            effort_limit if is_limited else np.inf,
            coordinates.units[k],
            physics.base_bandwidth if is_base else physics.arm_bandwidth,
            physics.damping_ratio,
            has_rotor=not is_base,
        )
        servos.append(servo)
    return tuple(servos)


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

    With the natural frequency ω and the damping ratio ζ, a servo that moves the inertia m has the
    stiffness k = m ω² and the damping 2 ζ √(k m). A motor with a force limit is stiff enough that a
    load of full effort deflects it by no more than `_SAG`.

    Args:
        coordinate: Driven coordinate.
        load_inertia: Largest inertia that it moves, without the rotor [kg·m²] or [kg].
        limit: Force limit [N·m] or [N]; infinite if there is none.
        unit: Unit of the coordinate, "rad" or "m".
        bandwidth: Natural frequency at that inertia [rad/s].
        damping_ratio: Damping ratio.
        has_rotor: Whether its motor has a rotor.
    """
    is_limited = bool(np.isfinite(limit))
    if not has_rotor:
        armature = 0.0
    elif is_limited:
        armature = limit * _ROTOR_INERTIA_PER_EFFORT
    else:
        armature = _ROTOR_INERTIA_RATIO * load_inertia
    inertia = load_inertia + armature
    stiffness = inertia * bandwidth**2
    if is_limited:
        stiffness = max(stiffness, limit / _SAG[unit])
    damping = 2.0 * damping_ratio * float(np.sqrt(stiffness * inertia))
    return Servo(coordinate, stiffness, damping, inertia, armature, limit)


def sample_reference(trajectory: Trajectory, times: Floats) -> tuple[Floats, Floats, Floats]:
    """Return positions, velocities and accelerations of the robot, shape (K, robot's) each.

    Without a curve, velocities are discontinuous and accelerations are zero.
    """
    robot = slice(0, trajectory.robot_size)
    positions = trajectory.at(times)[:, robot]
    if trajectory.curve is not None:
        velocities = trajectory.velocity(times)[:, robot]
        accelerations = trajectory.acceleration(times)[:, robot]
        return positions, velocities, accelerations
    later = trajectory.at(times + _DIFFERENCE / 2.0)[:, robot]
    earlier = trajectory.at(times - _DIFFERENCE / 2.0)[:, robot]
    velocities = (later - earlier) / _DIFFERENCE
    return positions, velocities, np.zeros_like(positions)


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
    robot = world.scene.robot
    model = pin.Model(robot.model if robot.gripper is None else robot.gripper.model)
    model.gravity = pin.Motion.Zero()
    for joint in range(1, model.njoints):
        model.inertias[joint] = world.model.inertias[joint]
    positions, robot_velocities, robot_accelerations = motion
    # Fingers count as at rest.
    padding = ((0, 0), (0, rows.shape[1] - positions.shape[1]))
    velocities = np.pad(robot_velocities, padding)
    accelerations = np.pad(robot_accelerations, padding)
    rotor_torques = accelerations * [servo.armature for servo in servos]
    headings = rows[:, 2]
    v, a = transform_to_base_axes(headings, velocities, accelerations)
    data = model.createData()
    states = zip(Coordinates(model).q(rows), v, a, strict=True)
    torques = np.array([pin.rnea(model, data, *state) for state in states])
    # The servos act along the world's axes.
    forces = rotate_into_base_frame(torques[:, 0], torques[:, 1], -headings)
    torques[:, :2] = np.transpose(forces)
    return rotor_torques + torques


def sample_fingers(world: World, rows: Floats, row_times: Floats, times: Floats) -> Floats:
    """Interpolate the finger positions at times [s], shape (K,): shape (K, fingers).

    Args:
        world: The scene.
        rows: World coordinates at the times `row_times`.
        row_times: Their times [s].
        times: Sampling times, shape (K,) [s].
    """
    gripper = world.scene.robot.gripper
    if gripper is None:
        return np.zeros((len(times), 0))
    first = len(world.scene.start)
    columns = rows[:, first : first + len(gripper.names)]
    return np.column_stack([np.interp(times, row_times, column) for column in columns.T])
