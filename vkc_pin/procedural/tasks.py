"""Lists possible steps in a scene, and generates random tasks: a room, and a step in it."""

from __future__ import annotations

from typing import Any

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.procedural.furniture.catalogue import KINDS
from vkc_pin.procedural.rooms.fixtures import RANDOM
from vkc_pin.procedural.rooms.random_room import RoomSettings, random_room
from vkc_pin.utils.arguments import check_instance, check_integer, check_number
from vkc_pin.world.models.articulated_object import ArticulatedObject, Attachment
from vkc_pin.world.scene.placed_object import PlacedObject
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Actuate, Grasp, Step

# fraction of a joint's range by which random tasks move it
_SHARES = (0.35, 0.65)
# [rad] range of joints without limits, to either side
_TURN = np.pi
# in one room
_MAX_OBJECTS = 2


def goals(scene: Scene, *, share: float = 0.5) -> tuple[Step, ...]:
    """Return steps that a hand could do with the objects of a scene, each on its own.

    For each fixed object, every joint next to its base that some attachment moves is moved up if it
    is in the lower half of its range, else down, by the attachment with the most freedoms. Free
    objects are grasped. Whether a step is feasible from the robot's start is not checked.

    Args:
        scene: Scene.
        share: Fraction of its range by which a joint is moved, above 0 and at most 1.

    Raises:
        InputError: `share` is out of range.
    """
    check_instance(scene, Scene, "scene")
    if not 0.0 < check_number(share, "share") <= 1.0:
        raise InputError("out of range", field="share", expected="above 0 and at most 1", got=share)
    found: list[Step] = []
    for name, placed in scene.objects.items():
        attachments = list(placed.object.attachments.values())
        if not placed.object.free:
            found += _list_joint_steps(name, placed, share)
        elif attachments:  # without, it cannot be grasped
            found.append(Grasp(name, _find_freest(attachments).name))
    return tuple(found)


def random_task(
    seed: int, settings: RoomSettings | None = None, **changes: Any
) -> tuple[Scene, tuple[Step, ...]]:
    """Return a random room and a reproducible random step in it: to open, close or grasp an object.

    Args:
        seed: Random seed, from 0; the room is `random_room(seed, ...)`.
        settings: Settings of the room; None: `RoomSettings()`.
        changes: Fields of `RoomSettings` that differ. Without `objects`, one or two random objects
            are drawn.

    Returns:
        Scene and steps, the inputs of `plan`.

    Raises:
        InputError: A number or a field is out of range, or the objects do not fit into a room of
            this size.
        UnknownNameError: There is no such field, or no such type of object.
    """
    rng = np.random.default_rng([6, check_integer(seed, "seed", low=0)])
    count = 1 + int(rng.integers(_MAX_OBJECTS))
    kinds = tuple(RANDOM + str(kind) for kind in rng.choice(sorted(KINDS), count, replace=False))
    share = round(float(rng.uniform(*_SHARES)), 3)
    if "objects" not in changes and (settings is None or settings.objects is None):
        changes["objects"] = kinds
    scene = random_room(seed, settings, **changes)
    candidates = goals(scene, share=share)
    if not candidates:
        raise InputError(
            "no step is possible in this room",
            field="objects",
            expected="an object to open or to grasp",
            got="nothing",
        )
    return scene, (candidates[int(rng.integers(len(candidates)))],)


def _list_joint_steps(name: str, placed: PlacedObject, share: float) -> list[Step]:
    """Return the steps that open or close the joints of an object."""
    item = placed.object
    attachments_of: dict[str, list[Attachment]] = {}
    for attachment in item.attachments.values():
        joint = _find_first_joint(item, attachment)
        # Pushes move a joint in one direction only.
        if joint is not None and attachment.contact == "grasp":
            attachments_of.setdefault(joint, []).append(attachment)
    steps: list[Step] = []
    for joint, attachments in attachments_of.items():
        k = item.coordinates.index(joint)
        now = float(placed.state[k])
        lower = item.lower[k] if np.isfinite(item.lower[k]) else now - _TURN
        upper = item.upper[k] if np.isfinite(item.upper[k]) else now + _TURN
        change = share * (upper - lower)
        goal = now + change if now <= (lower + upper) / 2.0 else now - change
        value = float(np.clip(round(goal, 3), lower, upper))  # a rounded limit may exceed itself
        steps.append(Actuate(name, {joint: value}, _find_freest(attachments).name))
    return steps


def _find_first_joint(item: ArticulatedObject, attachment: Attachment) -> str | None:
    """Return the joint next to the base that moves an attachment's link, or None."""
    joint = item.model.frames[item.link_frame(attachment.link)].parentJoint
    while item.model.parents[joint]:
        joint = item.model.parents[joint]
    return str(item.model.names[joint]) if joint else None


def _find_freest(attachments: list[Attachment]) -> Attachment:
    """Return the attachment with the most freedoms, the first of several."""
    return max(attachments, key=lambda attachment: len(attachment.freedoms))
