"""What can be asked for in a scene, and tasks made at random: a room, and something to do in it."""

from __future__ import annotations

from typing import Any

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.procedural.furniture.catalogue import KINDS
from vkc_pin.procedural.rooms.fixtures import RANDOM
from vkc_pin.procedural.rooms.random_room import random_room
from vkc_pin.procedural.rooms.settings import RoomSettings
from vkc_pin.utils.arguments import instance, number, whole
from vkc_pin.world.models.articulated_object import ArticulatedObject, Attachment
from vkc_pin.world.scene.placed_object import PlacedObject
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Actuate, Grasp, Step

__all__ = ["goals", "random_task"]

_SHARES = (0.35, 0.65)  # of a joint's range by which random tasks move it
_TURN = np.pi  # [rad] range of joints without limits
_OBJECTS = 2  # at most, of one room


def goals(scene: Scene, *, share: float = 0.5) -> tuple[Step, ...]:
    """Return what a hand can do with the objects of a scene, each as a step of its own.

    Of every object that stands fixed, each joint on the base that some attachment moves is moved up
    if it is in the lower half of its range, else down, by the attachment that leaves the hand most
    freedom. What is free is grasped. Nobody asks a planner whether any of it can be done from where
    the robot starts.

    Args:
        scene: The scene.
        share: By how much of its range a joint is moved, above 0 and at most 1.

    Raises:
        InputError: `share` is out of range.
    """
    instance(scene, Scene, "scene")
    if not 0.0 < number(share, "share") <= 1.0:
        raise InputError("out of range", field="share", expected="above 0 and at most 1", got=share)
    found: list[Step] = []
    for name, placed in scene.objects.items():
        if placed.object.free and not placed.object.attachments:
            continue  # too thick for any hand
        if placed.object.free:
            found.append(Grasp(name, _freest(list(placed.object.attachments.values())).name))
        else:
            found += _openings(name, placed, share)
    return tuple(found)


def random_task(
    seed: int, settings: RoomSettings | None = None, **changes: Any
) -> tuple[Scene, tuple[Step, ...]]:
    """Return a random room, and something to open, to close or to grasp in it; the same in every run.

    Args:
        seed: Which task, from 0; the room is `random_room(seed, ...)`.
        settings: What the room is like; None: `RoomSettings()`.
        changes: Fields of `RoomSettings` that are to be otherwise. Without `objects`, one or two of
            `random_object` are drawn.

    Returns:
        Scene and steps, as `plan` takes them.

    Raises:
        InputError: A number or a field is out of range, or the things find no place in a room of
            this size.
        UnknownNameError: There is no such field, or no such type of object.
    """
    rng = np.random.default_rng([6, whole(seed, "seed", low=0)])
    count = 1 + int(rng.integers(_OBJECTS))
    kinds = tuple(RANDOM + str(kind) for kind in rng.choice(sorted(KINDS), count, replace=False))
    share = round(float(rng.uniform(*_SHARES)), 3)
    if "objects" not in changes and (settings is None or settings.objects is None):
        changes["objects"] = kinds
    scene = random_room(seed, settings, **changes)
    offered = goals(scene, share=share)
    if not offered:
        raise InputError(
            "nothing can be done here",
            field="objects",
            expected="something to open or to carry",
            got="nothing",
        )
    return scene, (offered[int(rng.integers(len(offered)))],)


def _openings(name: str, placed: PlacedObject, share: float) -> list[Step]:
    """Return the steps that open or close the joints of an object."""
    item, reached = placed.object, dict[str, list[Attachment]]()
    for attachment in item.attachments.values():
        joint = _first_joint(item, attachment)
        if joint is not None and attachment.contact == "grasp":  # what is pushed goes one way only
            reached.setdefault(joint, []).append(attachment)
    steps: list[Step] = []
    for joint, attachments in reached.items():
        k = item.coordinates.index(joint)
        now = float(placed.state[k])
        lower, upper = (
            limit if np.isfinite(limit) else now + away
            for limit, away in zip((item.lower[k], item.upper[k]), (-_TURN, _TURN), strict=True)
        )
        by = share * (upper - lower)
        goal = now + by if now <= (lower + upper) / 2.0 else now - by
        within = float(
            np.clip(round(goal, 3), lower, upper)
        )  # in this order: rounded, a limit may be beyond itself
        steps.append(Actuate(name, {joint: within}, _freest(attachments).name))
    return steps


def _first_joint(item: ArticulatedObject, attachment: Attachment) -> str | None:
    """Return the joint that moves an attachment's link most directly from the base, if any does."""
    joint = item.model.frames[item.link_frame(attachment.link)].parentJoint
    while item.model.parents[joint]:
        joint = item.model.parents[joint]
    return str(item.model.names[joint]) if joint else None


def _freest(attachments: list[Attachment]) -> Attachment:
    """Return the attachment of most freedoms, the first of several."""
    return max(attachments, key=lambda attachment: len(attachment.freedoms))
