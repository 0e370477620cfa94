"""Finds how a base drives from its wheels: the axle of unsteered ones, and the steered ones."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.words import list_words, split_words
from vkc_pin.world.files.urdf import UrdfFile

_WHEEL_WORDS = list_words("wheel whl tyre tire")
_CASTER_WORDS = list_words("caster castor")
_SIDEWAYS_WORDS = list_words("mecanum omni omnidirectional swerve")
_LEVEL = 0.5  # largest vertical part of the axis of a wheel: it may lean by 30°
_UPRIGHT = 0.9  # smallest vertical part of a steering axis
_PARALLEL = 0.98  # smallest cosine between the axes of wheels that roll in one direction
# Distance [m] of the root from the axle, and angle [rad] of its x axis from the rolling direction,
# below which wheels slide by less than 10 mm/s at 2 rad/s and 1 m/s.
_AXLE_DISTANCE = 0.005
_AXLE_ANGLE = 0.01
_SKID_STEER_WHEELS = 4  # number of wheels of a base with skid steer or mecanum wheels


@dataclass(frozen=True, eq=False)
class Drive:
    """How a base drives, from its wheels.

    Attributes:
        kind: "omni", "differential" or "ackermann".
        why: Evidence.
        wheels: Joints of the unsteered wheels, or of all of an "omni" base.
        center: Point on their axle, or in the middle of several, that is nearest to the root, in
            the root link's frame, shape (2,) [m].
        yaw: Direction in which they roll, in the root link's frame [rad].
        turning_radius: Least turning radius of the middle of the axle [m], if it is "ackermann".
    """

    kind: str
    why: str
    wheels: tuple[str, ...]
    center: Floats
    yaw: float = 0.0
    turning_radius: float | None = None


@dataclass(frozen=True, eq=False)
class _Wheel:
    """A wheel in the root link's frame: position and axis, shape (3,), and its steering joint."""

    joint: str
    position: Floats
    axis: Floats
    steering: str | None
    is_caster: bool


def has_wheel_name(joint: ElementTree.Element) -> bool:
    """Return whether the name of a joint or of its child link says that it is a wheel."""
    child = joint.find("child")
    link = "" if child is None else child.get("link", "")
    return not _WHEEL_WORDS.isdisjoint([*split_words(joint.get("name", "")), *split_words(link)])


def find_drive(full: pin.Model, file: UrdfFile, carrying: Collection[str] = ()) -> Drive | None:
    """Return how a base drives, or None without wheels.

    Wheels are joints of this name that turn without limits about a level axis. Those behind a
    joint that turns about the vertical are steered: by a motor if this has limits and there are
    unsteered wheels, else as casters.

    Args:
        full: The robot with all joints; see `build_full_model`.
        file: Its URDF.
        carrying: Joints that carry the whole base or the arm, and steer no wheel.
    """
    words = set[str]()
    for element in (*file.root.findall("link"), *file.root.findall("joint")):
        words.update(split_words(element.get("name", "")))
    wheels = _find_wheels(full, file, carrying)
    if not _SIDEWAYS_WORDS.isdisjoint(words):
        return Drive("omni", "names of wheels", _get_names(wheels), np.zeros(2))
    if not wheels:
        return None
    unsteered = [wheel for wheel in wheels if wheel.steering is None]
    unsteered = [wheel for wheel in unsteered if not wheel.is_caster] or unsteered
    if not unsteered:
        return Drive("omni", "all wheels are steered", _get_names(wheels), np.zeros(2))
    axes = np.array([wheel.axis[:2] / np.linalg.norm(wheel.axis[:2]) for wheel in unsteered])
    cosines = np.abs(axes @ axes.T)
    if cosines.min() < _PARALLEL:
        why = "wheels that roll in different directions"
        return Drive("omni", why, _get_names(wheels), np.zeros(2))
    forward = _find_rolling_direction(axes)
    positions = np.array([wheel.position[:2] for wheel in unsteered])
    center = (positions.mean(axis=0) @ forward) * forward
    steered = list[_Wheel]()
    for wheel in wheels:
        if wheel.steering is not None and not wheel.is_caster:
            travel = _find_travel(full, wheel.steering)
            if 0.0 < travel < np.inf:
                steered.append(wheel)
    kind = "differential"
    why = "1 wheel" if len(unsteered) == 1 else f"{len(unsteered)} wheels"
    radius = None
    if steered:
        kind = "ackermann"
        why += f" and {len(steered)} steered ones"
        angle = min(_find_travel(full, str(wheel.steering)) for wheel in steered)
        radius = _compute_turning_radius(steered, center, forward, angle)
    elif len(unsteered) >= _SKID_STEER_WHEELS:
        why += ", as for skid steer; mecanum wheels would be `omni`"
    yaw = float(np.arctan2(forward[1], forward[0]))
    return Drive(kind, why, _get_names(unsteered), center, yaw, radius)


def _find_rolling_direction(axes: Floats) -> Floats:
    """Return the unit vector in which wheels with nearly parallel `axes`, shape (n, 2), roll."""
    # Axes of left and right wheels may be mirrored.
    signs = np.sign(axes @ axes[0])
    axle = (axes * signs[:, None]).mean(axis=0)
    axle /= np.linalg.norm(axle)
    # A wheel with the axis y rolls along x.
    forward = np.array([axle[1], -axle[0]])
    # Of the two directions, that towards x; or y, if it is across x.
    if forward @ [1.0, 1e-3] < 0.0:
        forward = -forward
    return forward


def _compute_turning_radius(
    steered: list[_Wheel], center: Floats, forward: Floats, angle: float
) -> float:
    """Return the least turning radius of the middle of the axle [m].

    The base turns about a point on the axle at the radius r. The axis of a wheel at the distance l
    ahead of the axle, and h to the inner side, passes through it if tan(angle) = l / (r − h).

    Args:
        steered: The steered wheels.
        center: Middle of the axle, shape (2,) [m].
        forward: Rolling direction, shape (2,).
        angle: Largest steering angle [rad].
    """
    across = np.array([-forward[1], forward[0]])
    length = min(abs((wheel.position[:2] - center) @ forward) for wheel in steered)
    half_track = max(abs(wheel.position[:2] @ across) for wheel in steered)
    return float(length / np.tan(min(angle, 0.5 * np.pi)) + half_track)


def is_on_axle(drive: Drive) -> bool:
    """Return whether the root lies on the axle, with x in the rolling direction."""
    if drive.kind == "omni":
        return True
    distance = float(np.linalg.norm(drive.center))
    return distance <= _AXLE_DISTANCE and abs(drive.yaw) <= _AXLE_ANGLE


def describe_misplaced_axle(drive: Drive) -> str:
    """Return where the axle of a base is that is not at its root."""
    parts = list[str]()
    distance = float(np.linalg.norm(drive.center))
    if distance > _AXLE_DISTANCE:
        x, y = np.round(drive.center, 3) + 0.0  # without negative zeros
        if abs(drive.yaw) <= _AXLE_ANGLE:
            side = "ahead of" if x > 0.0 else "behind"
            parts.append(f"{distance:.3f} m {side} the root link")
        else:
            parts.append(f"{distance:.3f} m from the root link, at x {x:.3f}, y {y:.3f}")
    if abs(drive.yaw) > _AXLE_ANGLE:
        parts.append(f"rolls at {np.degrees(drive.yaw):.0f}° from its x axis")
    middle = "the axle" if len(drive.wheels) < _SKID_STEER_WHEELS else "the middle"
    return f"{middle} of {', '.join(drive.wheels)} is {' and '.join(parts)}"


def _find_wheels(full: pin.Model, file: UrdfFile, carrying: Collection[str]) -> list[_Wheel]:
    data = full.createData()
    pin.forwardKinematics(full, data, pin.neutral(full))
    children = dict[str, str]()  # joint → child link
    for element in file.root.findall("joint"):
        child = element.find("child")
        if child is not None:
            children[element.get("name", "")] = child.get("link", "")
    wheels = list[_Wheel]()
    for element in file.root.findall("joint"):
        name = element.get("name", "")
        if not has_wheel_name(element) or not full.existJointName(name) or name in carrying:
            continue
        number = full.getJointId(name)
        axis = _find_axis(full, data, number)
        has_limits = np.isfinite(_find_travel(full, name))
        if has_limits or not axis.any() or abs(axis[2]) > _LEVEL:
            continue
        steering_joints = list[str]()
        # The joints between the base and the wheel.
        for joint in list(full.supports[number])[2:-1]:
            joint_name = str(full.names[joint])
            is_upright = abs(_find_axis(full, data, joint)[2]) > _UPRIGHT
            if joint_name not in carrying and is_upright:
                steering_joints.append(joint_name)
        words = set[str]()
        for joint_name in (name, *steering_joints):
            words.update(split_words(f"{joint_name} {children.get(joint_name, '')}"))
        wheel = _Wheel(
            joint=name,
            position=np.array(data.oMi[number].translation),
            axis=axis,
            steering=steering_joints[-1] if steering_joints else None,
            is_caster=not _CASTER_WORDS.isdisjoint(words),
        )
        wheels.append(wheel)
    return wheels


def _find_axis(full: pin.Model, data: pin.Data, number: int) -> Floats:
    """Return the axis about which a joint turns, shape (3,); zero if it does not."""
    # The motion subspace S has the linear velocity, then the angular one.
    motion = np.asarray(data.joints[number].S, float)
    if motion.size != 6:
        return np.zeros(3)
    return np.asarray(data.oMi[number].rotation @ motion.reshape(6)[3:])


def _find_travel(full: pin.Model, name: str) -> float:
    """Return the angle from 0 to a joint's nearer limit [rad]; infinite beyond half a turn."""
    moving = full.joints[full.getJointId(name)]
    if moving.nq != 1:
        return np.inf
    low = full.lowerPositionLimit[moving.idx_q]
    high = full.upperPositionLimit[moving.idx_q]
    return float(min(-low, high)) if high - low < 2.0 * np.pi else np.inf


def _get_names(wheels: list[_Wheel]) -> tuple[str, ...]:
    return tuple(wheel.joint for wheel in wheels)
