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
from vkc_pin.world.models.articulated_object import Attachment, Latch
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

    The unit is [m/rad], or 1 for a prismatic joint. The velocity of the link is linear in the
    position of the contact, so a region of slides has its extremes at the corners.
    """
    model, data = placed.object.model, placed.object.model.createData()
    frame, index = placed.object.link_frame(attachment.link), model.getJointId(joint)
    q = placed.object.coordinates.q(placed.state)
    # Pinocchio returns a vector for a single joint.
    jacobian = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL).reshape(6, -1)
    column = jacobian[:, model.joints[index].idx_v]
    into = attachment.placement.rotation[:, 2]
    found = [
        into @ (column[:3] + np.cross(column[3:], point))
        for point in _sample_contact_region(attachment)
    ]
    return float(min(found)), float(max(found))


def _sample_contact_region(attachment: Attachment) -> list[Floats]:
    """Return points of the contact region, including its corners, in the link's frame."""
    ranges = [
        np.linspace(
            own.lower,
            own.upper,
            2 if own.kind == "prismatic" else _SAMPLES if own.through.any() else 1,
        )
        for own in attachment.freedoms
    ]
    points = []
    for values in product(*ranges):
        moved = attachment.placement
        for freedom, value in zip(attachment.freedoms, values, strict=True):
            moved = moved * freedom.motion(float(value))
        points.append(moved.translation)
    return points


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
    own = {
        name.partition(".")[2]: value
        for name, value in state.items()
        if name.partition(".")[0] == placed.name
    }
    placed, directions = placed.with_state(own), dict[str, int]()
    at = f"'{placed.name}' at '{attachment.name}'"
    for coordinate, value in values.items():
        joint = coordinate.partition(".")[2]
        least, most = compute_advance(placed, attachment, joint)
        if least * most <= 0.0 or min(abs(least), abs(most)) < _MIN_ADVANCE:
            problem = f"pushing {at} does not move '{joint}' in a single direction"
            raise InputError(
                problem,
                field=where,
                expected="a face that lies entirely on one side of the joint's axis",
            )
        directions[coordinate] = direction = 1 if least > 0.0 else -1
        begin = state[coordinate]
        lower, upper = find_joint_limits(placed, coordinate)
        if (min(max(value, lower), upper) - begin) * direction < 0.0:
            only = "up" if direction > 0 else "down"
            problem = f"pushing {at} moves '{joint}' {only} only: a hand that pushes cannot pull"
            other = [
                name for name, one in placed.object.attachments.items() if one.contact != "push"
            ]
            expected = f"{'≥' if direction > 0 else '≤'} {begin:g}"
            expected += (
                f", or an attachment that can be grasped: {', '.join(other)}" if other else ""
            )
            raise InputError(problem, field=where, expected=expected, got=value)
    return directions


def find_blocking_latches(
    placed: PlacedObject, state: Mapping[str, float], values: Mapping[str, float]
) -> Iterator[Latch]:
    """Yield the latches of an object that block joints which are to move, now or on the way.

    Entries that the caller adds to `values` meanwhile count, since what releases a latch may itself
    be latched.

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
        is_released = min(_find_motion(placed, latch.released_by, state, values)) >= latch.threshold
        if latch.is_engaged(goal) and not latch.is_engaged(now) and not is_released:
            yield latch


def _find_motion(
    placed: PlacedObject, joint: str, state: Mapping[str, float], values: Mapping[str, float]
) -> tuple[float, float]:
    """Return the initial and the final value of a joint, [rad] or [m]."""
    name = f"{placed.name}.{joint}"
    now = state.get(name, float(placed.state[placed.object.coordinates.index(joint)]))
    return now, values.get(name, now)


def check_actuation(
    placed: PlacedObject,
    attachment: Attachment,
    state: Mapping[str, float],
    values: Mapping[str, float],
    where: str,
) -> None:
    """Check that a hand at an attachment can bring joints to values."""
    name, path = placed.name, find_path_joints(placed, attachment)
    for joint in (coordinate.partition(".")[2] for coordinate in values):
        if joint not in path:
            problem = f"joint '{joint}' does not move when '{name}' is held at '{attachment.name}'"
            expected = f"one of {', '.join(path)}" if path else "an attachment that moves with it"
            raise InputError(problem, field=f"{where}.joints", expected=expected)
    joints = zip(placed.object.coordinates.names, placed.state.tolist(), strict=True)
    state = {f"{name}.{joint}": value for joint, value in joints} | dict(state)
    wanted = dict(values)
    for latch in find_blocking_latches(placed, state, wanted):
        release = f"{name}.{latch.released_by}"
        if latch.released_by in path:
            wanted.setdefault(release, max(latch.threshold, state[release]))
        elif state[release] < latch.threshold:
            problem = f"'{latch.joint}' is latched, and '{latch.released_by}', which releases it, "
            problem += f"does not move when '{name}' is held at '{attachment.name}'"
            raise InputError(
                problem,
                field=f"{where}.attachment",
                expected=f"an attachment that moves '{latch.released_by}'",
            )
    find_push_directions(placed, attachment, state, values, f"{where}.joints")


def find_driving_attachments(
    placed: PlacedObject, state: Mapping[str, float], values: Mapping[str, float], where: str
) -> list[str]:
    """Return the attachments at which a hand can bring joints to values, in the object's order."""
    found, errors = list[str](), list[InputError]()
    for name, attachment in placed.object.attachments.items():
        try:
            check_actuation(placed, attachment, state, values, where)
        except InputError as error:
            errors.append(error)
        else:
            found.append(name)
    if not found and len(errors) == 1:
        raise errors[0]
    if not found:
        requested = " and ".join(f"'{coordinate.partition('.')[2]}'" for coordinate in values)
        moved = {
            name: ", ".join(find_path_joints(placed, one)) or "nothing"
            for name, one in placed.object.attachments.items()
        }
        problem = f"no attachment of '{placed.name}' can bring {requested} there"
        if all(error.problem.startswith("joint ") for error in errors):
            expected = "joints that one attachment moves: "
            expected += "; ".join(f"{name} moves {path}" for name, path in moved.items())
        else:
            expected = "one that can; " + "; ".join(
                f"{name}: {error.problem}" for name, error in zip(moved, errors, strict=True)
            )
        raise InputError(
            problem,
            field=f"{where}.joints",
            expected=expected,
            got=", ".join(map(str, values.values())),
        )
    return found


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
    return list(dict.fromkeys([*(name for name in used if name in fit), *fit]))


def find_driven_coordinates(scene: Scene, hold: Hold) -> list[str]:
    """Return the coordinates "<object>.<joint>" that a hold can move, base first."""
    placed = scene.objects[hold.object]
    return [
        f"{placed.name}.{joint}"
        for joint in find_path_joints(placed, placed.object.attachments[hold.attachment])
    ]


def find_shared_coordinate(scene: Scene, holds: Iterable[Hold]) -> str | None:
    """Return a coordinate that two of the holds have, of a joint or of a grasp, or None.

    Such holds cannot be part of the same kinematic chain.
    """
    driven = set[str]()
    for hold in holds:
        attachment = scene.objects[hold.object].object.attachments[hold.attachment]
        freedoms = [f"{hold.object}.{name}" for name in attachment.coordinates]
        own = [*find_driven_coordinates(scene, hold), *freedoms]
        if not driven.isdisjoint(own):
            return next(name for name in own if name in driven)
        driven.update(own)
    return None
