"""Computes limits of a robot's coordinates; coupled joints share the tightest limits."""

from __future__ import annotations

import itertools
from collections.abc import Set

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.urdf import UrdfFile
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.models.couplings.coupled_joints import check_followers, find_coupled_groups
from vkc_pin.world.models.robot_schema import RobotSchema
from vkc_pin.world.models.shapes import LIMIT_SLACK

__all__ = [
    "DEFAULT_JOINT_VELOCITY",
    "DEFAULT_SLIDE_VELOCITY",
    "apply_robot_limits",
    "tighten_coupled_limits",
]

DEFAULT_JOINT_VELOCITY = np.pi
"""Velocity limit of revolute joints for which no file states one [rad/s]."""
DEFAULT_SLIDE_VELOCITY = 0.1
"""Velocity limit of prismatic joints for which no file states one [m/s]; most of them are lifts."""
_DEFAULT_JOINT_ACCELERATION = 1.4  # [rad/s²] or [m/s²]


def tighten_coupled_limits(full: pin.Model, file: UrdfFile, tool_frame: str) -> pin.Model:
    """Return a model in which the limits of leaders respect the limits of their followers.

    Only groups with a joint on the path to the tool are considered. Continuous joints among them
    become revolute ones with infinite limits, since a full turn changes the followers' positions.

    Args:
        full: The robot with all joints.
        file: Its URDF.
        tool_frame: Name of the tool frame.
    """
    check_followers(full, file, tool_frame)
    groups = find_coupled_groups(full, file, tool_frame)
    if not groups:
        return full
    model = _bound_continuous_joints(
        full, {*groups, *itertools.chain.from_iterable(groups.values())}
    )
    lower, upper = model.lowerPositionLimit, model.upperPositionLimit
    for leader, group in groups.items():
        index = model.joints[model.getJointId(leader)].idx_q
        for joint, coupling in group.items():
            i = model.joints[model.getJointId(joint)].idx_q
            low, high = sorted(
                (bound - coupling.offset) / coupling.factor for bound in (lower[i], upper[i])
            )
            if max(low, lower[index]) > min(high, upper[index]) + LIMIT_SLACK:
                problem, expected = (
                    f"no position satisfies the limits of its follower '{joint}'",
                    f"limits that overlap {low:g} to {high:g}",
                )
                got = f"{lower[index]:g} to {upper[index]:g}"
                raise InputError(problem, file=file.path, field=leader, expected=expected, got=got)
            lower[index], upper[index] = (
                max(low, lower[index]),
                max(min(high, upper[index]), max(low, lower[index])),
            )
    model.lowerPositionLimit, model.upperPositionLimit = lower, upper
    return model


def apply_robot_limits(
    full: pin.Model, model: pin.Model, settings: RobotSchema, base: str
) -> tuple[Coordinates, Floats, Floats, Floats, Floats]:
    """Write the limits of a robot.yaml into a model, and return them.

    Args:
        full: The robot with all joints, see `tighten_coupled_limits`.
        model: The planned joints; changed in place.
        settings: The robot.yaml.
        base: Type of the base.

    Returns:
        Coordinates, lower and upper position limits, velocity and acceleration limits, shape (n,)
        each.
    """
    low, high = (
        np.array(settings.base.position).T if base != "fixed" else (np.zeros(2), np.zeros(2))
    )
    position_low, position_high = model.lowerPositionLimit, model.upperPositionLimit
    position_low[:2], position_high[:2] = low, high
    model.lowerPositionLimit, model.upperPositionLimit = position_low, position_high
    velocity, acceleration = np.full(model.nv, np.inf), np.full(model.nv, np.inf)
    velocity[:3], acceleration[:3] = settings.base.velocity, settings.base.acceleration
    coordinates = Coordinates(model)
    unit_rates = coordinates.compute_max_steps(
        1.0, 1.0
    )  # at which the fastest joint moves at 1 m/s or 1 rad/s
    default_velocity = coordinates.compute_max_steps(DEFAULT_SLIDE_VELOCITY, DEFAULT_JOINT_VELOCITY)
    for move in coordinates.moves[3:]:
        name, k, factor = model.names[move.joint], move.coordinate, abs(move.factor)
        joint_settings, urdf_velocity = (
            settings.joints.get(name),
            float(full.velocityLimit[full.joints[full.getJointId(name)].idx_v]),
        )
        if joint_settings is not None and joint_settings.velocity is not None:
            velocity[k] = min(velocity[k], joint_settings.velocity / factor)
        elif (
            0.0 < urdf_velocity < 1e3
        ):  # Pinocchio stores the largest float for joints without a limit
            velocity[k] = min(velocity[k], urdf_velocity / factor)
        if joint_settings is not None and joint_settings.acceleration is not None:
            acceleration[k] = min(acceleration[k], joint_settings.acceleration / factor)
    velocity = np.where(np.isinf(velocity), default_velocity, velocity)
    acceleration = np.where(
        np.isinf(acceleration), _DEFAULT_JOINT_ACCELERATION * unit_rates, acceleration
    )
    model.velocityLimit, model.effortLimit = (
        velocity,
        _read_torque_limits(model, coordinates, settings),
    )
    lower, upper = coordinates.lower.copy(), coordinates.upper.copy()
    if base == "fixed":
        lower[:3] = upper[:3] = 0.0
    return Coordinates(model), lower, upper, velocity.copy(), acceleration


def _read_torque_limits(
    model: pin.Model, coordinates: Coordinates, settings: RobotSchema
) -> Floats:
    """Return the effort limits, shape (n,) [N·m], [N]; coupled joints have that of their leader."""
    effort = model.effortLimit
    for k, joint in enumerate(coordinates.joints):
        joint_settings = settings.joints.get(model.names[joint])
        if joint_settings is not None and joint_settings.effort is not None:
            effort[k] = joint_settings.effort
    return np.asarray(effort)


def _bound_continuous_joints(full: pin.Model, joints: Set[str]) -> pin.Model:
    """Return a copy of a model in which some continuous joints are revolute, without limits."""
    model, data = pin.Model(), full.createData()
    model.name = full.name
    pin.forwardKinematics(full, data, pin.neutral(full))
    for j in range(1, full.njoints):
        joint, name, limits = (
            full.joints[j],
            str(full.names[j]),
            (full.lowerPositionLimit, full.upperPositionLimit),
        )
        parts = [bound[joint.idx_q : joint.idx_q + joint.nq] for bound in limits]
        if name in joints and joint.nq == 2:
            axis = np.asarray(data.joints[j].S, float).ravel()[3:]
            joint, parts = (
                pin.JointModelRevoluteUnaligned(axis),
                [np.array([-np.inf]), np.array([np.inf])],
            )
        v = slice(full.joints[j].idx_v, full.joints[j].idx_v + full.joints[j].nv)
        model.addJoint(
            full.parents[j],
            joint,
            full.jointPlacements[j],
            name,
            full.effortLimit[v],
            full.velocityLimit[v],
            *parts,
        )
        model.appendBodyToJoint(j, full.inertias[j], pin.SE3.Identity())
    for frame in full.frames[1:]:
        model.addFrame(frame, False)
    return model
