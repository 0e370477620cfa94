"""Limits of a robot's coordinates: of joints that move together, the shortest way and the slowest joint."""

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

__all__ = ["DEFAULT_JOINT_VELOCITY", "apply_robot_limits", "tighten_coupled_limits"]

DEFAULT_JOINT_VELOCITY = np.pi
"""Of joints for which no file names one [rad/s] or [m/s]."""
_DEFAULT_JOINT_ACCELERATION = 1.4  # the same [rad/s²] or [m/s²]


def tighten_coupled_limits(full: pin.Model, file: UrdfFile, tool_frame: str) -> pin.Model:
    """Return a robot whose joints that lead others on the way to the tool can go as far as these can follow.

    Such joints turn within limits, which may be infinite: a turn is not nothing to those that
    follow.

    Args:
        full: The robot with all its joints.
        file: Its file.
        tool_frame: A frame of it.

    Raises:
        InputError: What a joint on the way to the tool follows cannot move, or is not there; or
            limits leave nothing.
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
        at = model.joints[model.getJointId(leader)].idx_q
        for joint, led in group.items():
            i = model.joints[model.getJointId(joint)].idx_q
            low, high = sorted((bound - led.offset) / led.factor for bound in (lower[i], upper[i]))
            if max(low, lower[at]) > min(high, upper[at]) + LIMIT_SLACK:
                problem, expected = (
                    f"'{joint}', which follows it, has nowhere to go",
                    f"limits that meet {low:g} to {high:g}",
                )
                got = f"{lower[at]:g} to {upper[at]:g}"
                raise InputError(problem, file=file.path, field=leader, expected=expected, got=got)
            lower[at], upper[at] = (
                max(low, lower[at]),
                max(min(high, upper[at]), max(low, lower[at])),
            )
    model.lowerPositionLimit, model.upperPositionLimit = lower, upper
    return model


def apply_robot_limits(
    full: pin.Model, model: pin.Model, settings: RobotSchema, base: str
) -> tuple[Coordinates, Floats, Floats, Floats, Floats]:
    """Write the limits into a robot's model; return its coordinates, and lower, upper, velocity, acceleration, shape (n,) each.

    Args:
        full: The robot with all its joints, see `tighten_coupled_limits`.
        model: Those of them that are planned; changed in place.
        settings: Its robot.yaml.
        base: How it moves.
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
    unsaid = coordinates.compute_max_steps(
        1.0, 1.0
    )  # at which rate of a coordinate its fastest joint has one of 1
    for move in coordinates.moves[3:]:
        name, k, share = model.names[move.joint], move.coordinate, abs(move.factor)
        named, own = (
            settings.joints.get(name),
            float(full.velocityLimit[full.joints[full.getJointId(name)].idx_v]),
        )
        if named is not None and named.velocity is not None:
            velocity[k] = min(velocity[k], named.velocity / share)
        elif 0.0 < own < 1e3:  # Pinocchio's value for a joint without limit is the largest number
            velocity[k] = min(velocity[k], own / share)
        if named is not None and named.acceleration is not None:
            acceleration[k] = min(acceleration[k], named.acceleration / share)
    velocity = np.where(np.isinf(velocity), DEFAULT_JOINT_VELOCITY * unsaid, velocity)
    acceleration = np.where(
        np.isinf(acceleration), _DEFAULT_JOINT_ACCELERATION * unsaid, acceleration
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
    """Return the efforts of the motors, shape (n,): of joints that move together the leading one has it."""
    effort = model.effortLimit
    for k, joint in enumerate(coordinates.joints):
        named = settings.joints.get(model.names[joint])
        if named is not None and named.effort is not None:
            effort[k] = named.effort
    return np.asarray(effort)


def _bound_continuous_joints(full: pin.Model, joints: Set[str]) -> pin.Model:
    """Return a copy of a model in which those of some joints that turn without end do so between infinite limits."""
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
