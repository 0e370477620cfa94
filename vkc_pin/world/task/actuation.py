"""What a hand can do with an object's joints from where it has it: which it moves and unlatches, and which way it pushes.

A hand that pushes moves what it touches ahead of it, and pulls nothing.
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
from vkc_pin.world.task.lookup import find_attachment, find_joint_limits, find_path_joints

__all__ = [
    "check_actuation",
    "choose_attachment",
    "compute_advance",
    "find_driven_coordinates",
    "find_driving_attachments",
    "find_engaged_latches",
    "find_push_directions",
    "find_shared_coordinate",
]

# values of a freedom that turns, about points elsewhere, at which the contact is looked at; a
# slide's ends are enough
_PARTS = 9
_LEAST = 1e-3  # [m] a radian, or of a metre: what moves the contact less is not pushed


def compute_advance(
    placed: PlacedObject, attachment: Attachment, joint: str
) -> tuple[float, float]:
    """Return how far the contact moves into its face when a joint does, [m/rad] or 1: the least and the most over the region.

    The velocity of the link at the contact is linear in where that is, so a region of slides has
    its extremes at corners.

    Args:
        placed: The object, at the state at which that is asked.
        attachment: Where it is pushed.
        joint: Of the object.
    """
    model, data = placed.object.model, placed.object.model.createData()
    frame, index = placed.object.link_frame(attachment.link), model.getJointId(joint)
    q = placed.object.coordinates.q(placed.state)
    jacobian = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL).reshape(
        6, -1
    )  # of one joint it has one dimension
    column = jacobian[:, model.joints[index].idx_v]
    into = attachment.placement.rotation[:, 2]
    found = [into @ (column[:3] + np.cross(column[3:], point)) for point in _region(attachment)]
    return float(min(found)), float(max(found))


def _region(attachment: Attachment) -> list[Floats]:
    """Return points of the region that may be touched, in the link's frame, among them its corners."""
    ranges = [
        np.linspace(
            own.lower,
            own.upper,
            2 if own.kind == "prismatic" else _PARTS if own.through.any() else 1,
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
    """Return which way a push moves each of some coordinates, 1 up or -1 down; nothing where the hand takes hold.

    Args:
        placed: The object.
        attachment: Where the hand has it.
        state: Coordinate "<object>.<joint>" → value at the begin [rad] or [m].
        values: The same at the end.
        where: The field that asks for it, for errors.

    Raises:
        InputError: Pushing there does not move a joint, or not all of the region moves it the same
            way, or not that way.
    """
    if attachment.contact != "push":
        return {}
    own = {
        name.partition(".")[2]: value
        for name, value in state.items()
        if name.partition(".")[0] == placed.name
    }
    placed, ways = placed.with_state(own), dict[str, int]()
    at = f"'{placed.name}' at '{attachment.name}'"
    for coordinate, value in values.items():
        joint = coordinate.partition(".")[2]
        least, most = compute_advance(placed, attachment, joint)
        if least * most <= 0.0 or min(abs(least), abs(most)) < _LEAST:
            problem = f"pushing {at} does not move '{joint}' one way"
            raise InputError(
                problem,
                field=where,
                expected="a face all of which lies on one side of the joint's axis",
            )
        ways[coordinate] = way = 1 if least > 0.0 else -1
        begin = state[coordinate]
        lower, upper = find_joint_limits(placed, coordinate)
        if (min(max(value, lower), upper) - begin) * way < 0.0:
            problem = f"pushing {at} moves '{joint}' {'up' if way > 0 else 'down'} only: a hand that pushes cannot pull"
            other = [
                name for name, one in placed.object.attachments.items() if one.contact != "push"
            ]
            expected = f"{'≥' if way > 0 else '≤'} {begin:g}"
            expected += f", or an attachment to hold it by: {', '.join(other)}" if other else ""
            raise InputError(problem, field=where, expected=expected, got=value)
    return ways


def find_engaged_latches(
    placed: PlacedObject, state: Mapping[str, float], values: Mapping[str, float]
) -> Iterator[Latch]:
    """Yield the latches of an object that hold joints which are to move from where they are.

    What is added to `values` meanwhile counts: what releases a latch may be latched itself.

    Args:
        placed: The object.
        state: Coordinate "<object>.<joint>" → value at the begin [rad] or [m]; those it lacks are
            as the scene has them.
        values: The same at the end, for the joints that are to move.
    """
    for latch in placed.object.latches:
        coordinate = f"{placed.name}.{latch.joint}"
        now = state.get(
            coordinate, float(placed.state[placed.object.coordinates.index(latch.joint)])
        )
        if values.get(coordinate, now) != now and abs(now - latch.held_at) <= latch.engaged_within:
            yield latch


def check_actuation(
    placed: PlacedObject,
    attachment: Attachment,
    state: Mapping[str, float],
    values: Mapping[str, float],
    where: str,
) -> None:
    """Check that a hand which has an object at an attachment can bring joints to values.

    Args:
        placed: The object.
        attachment: Where the hand has it.
        state: Coordinate "<object>.<joint>" → value at the begin [rad] or [m]; those it lacks are
            as the scene has them.
        values: The same at the end, for the joints that are to move.
        where: The step that asks for it, for errors.

    Raises:
        InputError: A joint, or what releases its latch, does not move with the attachment, or a
            push cannot move it that way.
    """
    name, path = placed.name, find_path_joints(placed, attachment)
    for joint in (coordinate.partition(".")[2] for coordinate in values):
        if joint not in path:
            problem = f"joint '{joint}' does not move when '{name}' is held at '{attachment.name}'"
            expected = f"one of {', '.join(path)}" if path else "an attachment that moves with it"
            raise InputError(problem, field=f"{where}.joints", expected=expected)
    joints = zip(placed.object.coordinates.names, placed.state.tolist(), strict=True)
    state, wanted = (
        {f"{name}.{joint}": value for joint, value in joints} | dict(state),
        dict(values),
    )
    for latch in find_engaged_latches(placed, state, wanted):
        release = f"{name}.{latch.released_by}"
        if latch.released_by in path:
            wanted.setdefault(release, max(latch.threshold, state[release]))
        elif state[release] < latch.threshold:
            problem = f"'{latch.joint}' is latched, and '{latch.released_by}', which releases it, does not move when "
            problem += f"'{name}' is held at '{attachment.name}'"
            raise InputError(
                problem,
                field=f"{where}.attachment",
                expected=f"an attachment that moves '{latch.released_by}'",
            )
    find_push_directions(placed, attachment, state, values, f"{where}.joints")


def find_driving_attachments(
    placed: PlacedObject, state: Mapping[str, float], values: Mapping[str, float], where: str
) -> list[str]:
    """Return the attachments at which a hand can bring joints of an object to values, in the object's order.

    Args:
        placed: The object.
        state: As for `check_actuation`.
        values: As for `check_actuation`.
        where: The step that asks for it, for errors.

    Raises:
        InputError: There is none; the error says what each of them moves, or why not the only one.
    """
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
        asked = " and ".join(f"'{coordinate.partition('.')[2]}'" for coordinate in values)
        moved = {
            name: ", ".join(find_path_joints(placed, one)) or "nothing"
            for name, one in placed.object.attachments.items()
        }
        problem = f"no attachment of '{placed.name}' can bring {asked} there"
        if all(error.problem.startswith("joint ") for error in errors):
            expected = f"joints that one attachment moves: {'; '.join(f'{name} moves {path}' for name, path in moved.items())}"
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


def choose_attachment(
    placed: PlacedObject,
    named: str | None,
    used: Iterable[str],
    state: Mapping[str, float],
    values: Mapping[str, float],
    where: str,
) -> str:
    """Return the attachment at which a hand brings joints to values: the one that is named, or else the first that can.

    Args:
        placed: The object.
        named: By the step; None leaves it open.
        used: Attachments that come before the others then: the one in the hand, and the one that
            was.
        state: As for `check_actuation`.
        values: As for `check_actuation`.
        where: The step that asks for it, for errors.

    Raises:
        UnknownNameError: There is none of that name.
        InputError: It cannot, or none can.
    """
    attachment = find_attachment(placed, named, f"{where}.attachment")
    if named is not None:
        check_actuation(placed, attachment, state, values, where)
        return attachment.name
    fit = find_driving_attachments(placed, state, values, where)
    return next((name for name in used if name in fit), fit[0])


def find_driven_coordinates(scene: Scene, hold: Hold) -> list[str]:
    """Return the coordinates "<object>.<joint>" that a hold can move, base first."""
    placed = scene.objects[hold.object]
    return [
        f"{placed.name}.{joint}"
        for joint in find_path_joints(placed, placed.object.attachments[hold.attachment])
    ]


def find_shared_coordinate(scene: Scene, holds: Iterable[Hold]) -> str | None:
    """Return a coordinate that two of some holds move, which has no place in one chain then; None if there is none."""
    seen = set[str]()
    for hold in holds:
        own = find_driven_coordinates(scene, hold)
        if not seen.isdisjoint(own):
            return next(name for name in own if name in seen)
        seen.update(own)
    return None
