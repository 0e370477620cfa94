"""Determines which joints of an object a hand can move from an attachment, and in which direction.

A hand that pushes moves the touched link forward only; it cannot pull.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from itertools import product

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.articulated_object import Attachment, Freedom, Latch
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.placed_object import PlacedObject
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.lookup import (
    check_graspable,
    find_attachment,
    find_joint_limits,
    find_path_joints,
)

# Samples of a revolute freedom about a distant axis; of a slide, the ends suffice.
_SAMPLES = 9
_MIN_ADVANCE = 1e-3  # [m/rad] or 1: below this, a push does not move the joint


def compute_advance(
    placed: PlacedObject, attachment: Attachment, joint: str
) -> tuple[float, float]:
    """Return the smallest and largest advance of the contact into its face per unit of a joint.

    The unit is [m/rad], or 1 for a prismatic joint. At unit velocity of the joint, the link's frame
    has the velocity v and the angular velocity ω, and its point p the velocity v + ω × p. With the
    inward normal n, the advance is n · (v + ω × p). It is linear in p, so a region of slides has
    its extremes at the corners.
    """
    model = placed.object.model
    data = model.createData()
    frame = placed.object.link_frame(attachment.link)
    index = model.getJointId(joint)
    q = placed.object.coordinates.q(placed.state)
    # Pinocchio returns a vector for a single joint.
    jacobian = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL).reshape(6, -1)
    twist = jacobian[:, model.joints[index].idx_v]
    velocity = twist[:3]
    angular_velocity = twist[3:]
    normal = attachment.placement.rotation[:, 2]
    advances = list[float]()
    for point in _sample_contact_region(attachment):
        advances.append(normal @ (velocity + np.cross(angular_velocity, point)))
    return float(min(advances)), float(max(advances))


def _sample_contact_region(attachment: Attachment) -> list[Floats]:
    """Return points of the contact region, including its corners, in the link's frame."""
    ranges = [_sample_freedom(freedom) for freedom in attachment.freedoms]
    points = []
    for values in product(*ranges):
        moved = attachment.placement
        for freedom, value in zip(attachment.freedoms, values, strict=True):
            moved = moved * freedom.motion(float(value))
        points.append(moved.translation)
    return points


def _sample_freedom(freedom: Freedom) -> Floats:
    """Return the values of a freedom at which the contact region is sampled, [m] or [rad]."""
    if freedom.kind == "prismatic":
        return np.linspace(freedom.lower, freedom.upper, 2)
    # A rotation about the contact itself does not move it.
    count = _SAMPLES if freedom.through.any() else 1
    return np.linspace(freedom.lower, freedom.upper, count)


def find_push_directions(
    placed: PlacedObject,
    attachment: Attachment,
    state: Mapping[str, float],
    values: Mapping[str, float],
    where: str,
) -> dict[str, int]:
    """Return the direction in which a push moves each coordinate, 1 or -1; empty for a grasp."""
    if attachment.contact != "push":
        return {}
    own_values = dict[str, float]()
    for name, value in state.items():
        owner, _, joint = name.partition(".")
        if owner == placed.name:
            own_values[joint] = value
    placed = placed.with_state(own_values)
    directions = dict[str, int]()
    push = f"pushing '{placed.name}' at '{attachment.name}'"
    for coordinate, value in values.items():
        _, _, joint = coordinate.partition(".")
        least, most = compute_advance(placed, attachment, joint)
        smallest = min(abs(least), abs(most))
        if least * most <= 0.0 or smallest < _MIN_ADVANCE:
            raise InputError(
                f"{push} does not move '{joint}' in a single direction",
                field=where,
                expected="a face that lies entirely on one side of the joint's axis",
            )
        direction = 1 if least > 0.0 else -1
        directions[coordinate] = direction
        begin = state[coordinate]
        lower, upper = find_joint_limits(placed, coordinate)
        goal = min(max(value, lower), upper)
        if (goal - begin) * direction < 0.0:
            only = "up" if direction > 0 else "down"
            bound = "≥" if direction > 0 else "≤"
            expected = f"{bound} {begin:g}"
            attachments = placed.object.attachments
            others = [name for name, one in attachments.items() if one.contact != "push"]
            if others:
                expected += f", or an attachment that can be grasped: {', '.join(others)}"
            raise InputError(
                f"{push} moves '{joint}' {only} only: a hand that pushes cannot pull",
                field=where,
                expected=expected,
                got=value,
            )
    return directions


def find_blocking_latches(
    placed: PlacedObject, state: Mapping[str, float], values: Mapping[str, float]
) -> Iterator[Latch]:
    """Yield the latches of an object that block joints which are to move, now or on their path.

    Entries that the caller adds to `values` meanwhile count, since the joint that releases a latch
    may itself be latched.

    Args:
        placed: Object.
        state: Coordinate "<object>.<joint>" → initial value [rad] or [m]; default: that in the
            scene.
        values: Coordinate → final value, for the joints that are to move.
    """
    for latch in placed.object.latches:
        now, goal = _find_motion(placed, latch.joint, state, values)
        passes = (now - latch.held_at) * (goal - latch.held_at) < 0.0
        if goal != now and (latch.is_engaged(now) or passes):
            yield latch


def find_closing_latches(
    placed: PlacedObject, state: Mapping[str, float], values: Mapping[str, float]
) -> Iterator[Latch]:
    """Yield the latches that begin to act when joints move; see `find_blocking_latches`."""
    for latch in placed.object.latches:
        now, goal = _find_motion(placed, latch.joint, state, values)
        release = _find_motion(placed, latch.released_by, state, values)
        is_released = min(release) >= latch.threshold
        if latch.is_engaged(goal) and not latch.is_engaged(now) and not is_released:
            yield latch


def _find_motion(
    placed: PlacedObject, joint: str, state: Mapping[str, float], values: Mapping[str, float]
) -> tuple[float, float]:
    """Return the initial and the final value of a joint, [rad] or [m]."""
    name = f"{placed.name}.{joint}"
    in_scene = float(placed.state[placed.object.coordinates.index(joint)])
    now = state.get(name, in_scene)
    return now, values.get(name, now)


def check_actuation(
    placed: PlacedObject,
    attachment: Attachment,
    state: Mapping[str, float],
    values: Mapping[str, float],
    where: str,
) -> None:
    """Check that a hand at an attachment can bring joints to values."""
    name = placed.name
    path = find_path_joints(placed, attachment)
    for coordinate in values:
        _, _, joint = coordinate.partition(".")
        if joint not in path:
            problem = f"joint '{joint}' does not move when '{name}' is held at '{attachment.name}'"
            expected = f"one of {', '.join(path)}" if path else "an attachment that moves with it"
            raise InputError(problem, field=f"{where}.joints", expected=expected)
    full_state = dict[str, float]()
    for joint, value in zip(placed.object.coordinates.names, placed.state.tolist(), strict=True):
        full_state[f"{name}.{joint}"] = value
    full_state.update(state)
    wanted = dict(values)
    for latch in find_blocking_latches(placed, full_state, wanted):
        release = f"{name}.{latch.released_by}"
        if latch.released_by in path:
            wanted.setdefault(release, max(latch.threshold, full_state[release]))
        elif full_state[release] < latch.threshold:
            raise InputError(
                f"'{latch.joint}' is latched, and '{latch.released_by}', which releases it, does "
                f"not move when '{name}' is held at '{attachment.name}'",
                field=f"{where}.attachment",
                expected=f"an attachment that moves '{latch.released_by}'",
            )
    find_push_directions(placed, attachment, full_state, values, f"{where}.joints")


def find_driving_attachments(
    placed: PlacedObject, state: Mapping[str, float], values: Mapping[str, float], where: str
) -> list[str]:
    """Return the attachments at which a hand can bring joints to values, in the object's order."""
    found = list[str]()
    errors = dict[str, InputError]()
    for name, attachment in placed.object.attachments.items():
        try:
            check_actuation(placed, attachment, state, values, where)
        except InputError as error:
            errors[name] = error
        else:
            found.append(name)
    if found:
        return found
    if len(errors) == 1:
        raise next(iter(errors.values()))
    raise _make_actuation_error(placed, errors, values, where)


def _make_actuation_error(
    placed: PlacedObject, errors: Mapping[str, InputError], values: Mapping[str, float], where: str
) -> InputError:
    """Return the error for joints that a hand cannot move at any attachment, given its errors."""
    requested = [f"'{coordinate.partition('.')[2]}'" for coordinate in values]
    reasons = list[str]()
    if all(error.problem.startswith("joint ") for error in errors.values()):
        expected = "joints that one attachment moves: "
        for name, attachment in placed.object.attachments.items():
            path = ", ".join(find_path_joints(placed, attachment)) or "nothing"
            reasons.append(f"{name} moves {path}")
    else:
        expected = "one that can; "
        for name, error in errors.items():
            reasons.append(f"{name}: {error.problem}")
    return InputError(
        f"no attachment of '{placed.name}' can bring {' and '.join(requested)} there",
        field=f"{where}.joints",
        expected=expected + "; ".join(reasons),
        got=", ".join(map(str, values.values())),
    )


def list_driving_attachments(
    placed: PlacedObject,
    named: str | None,
    used: Iterable[str],
    state: Mapping[str, float],
    values: Mapping[str, float],
    where: str,
) -> list[str]:
    """Return the attachments at which a hand may bring joints to values, the preferred one first.

    It is the named one alone, or else all that can: first those that are `used` by the task.
    """
    if named is not None:
        attachment = find_attachment(placed, named, f"{where}.attachment")
        check_actuation(placed, attachment, state, values, where)
        return [named]
    check_graspable(placed, f"{where}.attachment")
    fit = find_driving_attachments(placed, state, values, where)
    preferred = [name for name in used if name in fit]
    return list(dict.fromkeys([*preferred, *fit]))


def find_driven_coordinates(scene: Scene, hold: Hold) -> list[str]:
    """Return the coordinates "<object>.<joint>" that a hold can move, base first."""
    placed = scene.objects[hold.object]
    path = find_path_joints(placed, placed.object.attachments[hold.attachment])
    return [f"{placed.name}.{joint}" for joint in path]


def find_shared_coordinate(scene: Scene, holds: Iterable[Hold]) -> str | None:
    """Return a coordinate that two of the holds have, of a joint or of a grasp, or None.

    Such holds cannot be part of the same kinematic chain.
    """
    driven = set[str]()
    for hold in holds:
        attachment = scene.objects[hold.object].object.attachments[hold.attachment]
        freedoms = [f"{hold.object}.{name}" for name in attachment.coordinates]
        own = [*find_driven_coordinates(scene, hold), *freedoms]
        for name in own:
            if name in driven:
                return name
        driven.update(own)
    return None
