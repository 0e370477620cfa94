"""The position servos of base, arm and fingers, and what they follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.simulation.physics import Physics
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.trajectory.dynamics.torques import in_base_axes
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.wheels import seen
from vkc_pin.world.trajectory.world_model import World

__all__ = ["Servo", "efforts_for", "finger_rows", "position_servo", "reference", "servos"]

_UNLIMITED = 1e300  # Pinocchio's efforts above this are none
_SPIN_UP = (
    1.0 / 1500.0
)  # [s²] full effort would accelerate a joint's own rotor by 1500 rad/s²: 0.1 kg·m² at 150 N·m
_SAG = {"rad": 0.05, "m": 0.005}  # a load that needs full effort moves a joint by so much, at most
_ROTOR = 0.05  # of the inertia that it moves, for joints without a stated effort
_POSTURES = 40  # along the plan, at which inertias are looked at
_SPAN = 0.01  # [s] over which velocities are taken


@dataclass(frozen=True)
class Servo:
    """A position servo with feed-forward: stiffness · (z − actual) + damping · (ż − actual velocity) + what z̈ takes.

    Attributes:
        coordinate: What it drives, by its name in the world.
        stiffness: [N·m/rad] or [N/m].
        damping: [N·m·s/rad] or [N·s/m].
        inertia: The largest that it moves, its rotor's included [kg·m²] or [kg].
        armature: Inertia of the rotor, seen at the joint [kg·m²] or [kg].
        limit: Of its force, what it carries of the robot's own weight included [N·m] or [N];
            infinite if nobody states one.
    """

    coordinate: str
    stiffness: float
    damping: float
    inertia: float
    armature: float
    limit: float

    def give_motor(self, joint: Any, mj: Any) -> None:
        """Give a joint of a `mujoco.MjSpec` what the motor brings along."""
        joint.armature, joint.actgravcomp = self.armature, True
        if np.isfinite(self.limit):
            joint.actfrclimited, joint.actfrcrange = (
                mj.mjtLimited.mjLIMITED_TRUE,
                [-self.limit, self.limit],
            )

    def add_to(self, spec: Any, mj: Any) -> None:
        """Add the servo to a `mujoco.MjSpec` that has the joint."""
        actuator = spec.add_actuator(
            name=self.coordinate, target=self.coordinate, trntype=mj.mjtTrn.mjTRN_JOINT
        )
        actuator.gaintype, actuator.biastype = mj.mjtGain.mjGAIN_FIXED, mj.mjtBias.mjBIAS_AFFINE
        actuator.gainprm[0], actuator.biasprm[:3] = (
            self.stiffness,
            [0.0, -self.stiffness, -self.damping],
        )


def servos(world: World, rows: Floats, physics: Physics) -> tuple[Servo, ...]:
    """Return the servos of a robot, in the order of the world's coordinates: base, arm, fingers.

    Args:
        world: The scene.
        rows: The world along the plan, shape (K, n): each servo is made for the largest inertia
            that it moves there.
        physics: Bandwidths and damping.
    """
    model, data, robot = world.model, world.model.createData(), world.scene.robot
    count = len(world.scene.start) + (0 if robot.gripper is None else len(robot.gripper.names))
    inertias = np.zeros(model.nv)
    for q in world.coordinates.q(rows[:: max(1, len(rows) // _POSTURES)]):
        inertias = np.maximum(inertias, np.diag(pin.crba(model, data, q)))
    found = []
    for k, name in enumerate(world.coordinates.names[:count]):
        velocity = model.joints[world.coordinates.joints[k]].idx_v + (k if k < 3 else 0)
        stated, moved = float(model.effortLimit[velocity]), float(inertias[velocity])
        limit = stated if 0.0 < stated < _UNLIMITED and k > 2 else np.inf
        bandwidth = physics.base_bandwidth if k < 3 else physics.arm_bandwidth
        unit = world.coordinates.units[k]
        found.append(
            position_servo(name, moved, limit, unit, bandwidth, physics.damping_ratio, rotor=k > 2)
        )
    return tuple(found)


def position_servo(
    coordinate: str,
    moved: float,
    limit: float,
    unit: str,
    bandwidth: float,
    damping_ratio: float,
    *,
    rotor: bool = True,
) -> Servo:
    """Return a servo.

    Args:
        coordinate: What it drives.
        moved: The largest inertia that it moves [kg·m²] or [kg].
        limit: Of its force [N·m] or [N]; infinite: none.
        unit: Of the coordinate, "rad" or "m".
        bandwidth: Its natural frequency, for that inertia [rad/s].
        damping_ratio: Its damping ratio.
        rotor: Whether its motor has a rotor.
    """
    armature = 0.0 if not rotor else limit * _SPIN_UP if np.isfinite(limit) else _ROTOR * moved
    inertia = moved + armature
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


def reference(trajectory: Trajectory, times: Floats) -> tuple[Floats, Floats, Floats]:
    """Return what the robot is to follow at times [s], shape (K,): positions, velocities, accelerations, shape (K, robot's) each.

    Without a curve velocities jump, and there are no accelerations.
    """
    robot = slice(0, trajectory.robot_size)
    if trajectory.curve is not None:
        read = trajectory.at, trajectory.velocity, trajectory.acceleration
        positions, velocities, accelerations = (values(times)[:, robot] for values in read)
        return positions, velocities, accelerations
    ahead, behind = (
        trajectory.at(times + shift)[:, robot] for shift in (_SPAN / 2.0, -_SPAN / 2.0)
    )
    return trajectory.at(times)[:, robot], (ahead - behind) / _SPAN, np.zeros_like(ahead)


def efforts_for(
    world: World, servos: Sequence[Servo], rows: Floats, motion: tuple[Floats, Floats, Floats]
) -> Floats:
    """Return what motors have to do for a motion of base and arm by the robot's own model, shape (K, servos) [N·m], [N].

    That is the inverse dynamics of the whole robot and the rotors, without its weight, which motors
    carry anyway: what a controller adds that computes torques. Of what the hand holds it knows
    nothing.

    Args:
        world: The scene, all of whose bodies have masses.
        servos: Of base, arm and fingers, as many as the rows have columns.
        rows: Where these are, shape (K, servos).
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
    found = accelerations * [servo.armature for servo in servos]
    v, a = in_base_axes(rows[:, 2], velocities, accelerations)
    data = model.createData()
    torques = np.array(
        [
            pin.rnea(model, data, *state)
            for state in zip(Coordinates(model).q(rows), v, a, strict=True)
        ]
    )
    torques[:, :2] = np.transpose(
        seen(torques[:, 0], torques[:, 1], -rows[:, 2])
    )  # along the floor's axes, as the servos are
    return found + torques


def finger_rows(world: World, rows: Floats, known: Floats, times: Floats) -> Floats:
    """Return where the fingers are at times [s], shape (K,), of rows of the world at `known` times, shape (K, fingers)."""
    first = len(world.scene.start)
    gripper = world.scene.robot.gripper
    columns: Sequence[int] = range(first, first + (0 if gripper is None else len(gripper.names)))
    return np.column_stack(
        [np.zeros((len(times), 0)), *(np.interp(times, known, rows[:, k]) for k in columns)]
    )
