"""Finds what steps name in a scene: objects, attachments, links, joints, frames and openings."""

from __future__ import annotations

from collections.abc import Sequence

import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.utils.arguments import check_choice
from vkc_pin.world.models.articulated_object import Attachment
from vkc_pin.world.scene.contact_rules import (
    compute_grasp_opening,
    compute_start_opening,
    find_gripper_hold,
)
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.placed_object import PlacedObject
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.phases import Phase


def find_object(scene: Scene, name: str, where: str) -> PlacedObject:
    """Return an object of a scene."""
    return scene.objects[check_choice(name, scene.objects, "object", where)]


def find_attachment(placed: PlacedObject, name: str, where: str) -> Attachment:
    """Return an object's attachment `name`."""
    attachments = placed.object.attachments
    if name not in attachments:
        raise UnknownNameError(f"attachment of '{placed.name}'", name, attachments, field=where)
    return attachments[name]


def check_graspable(placed: PlacedObject, where: str) -> None:
    """Check that an object has an attachment."""
    if not placed.object.attachments:
        problem = f"object '{placed.name}' has no attachment, so it cannot be grasped"
        raise InputError(problem, field=where)


def list_graspable_attachments(placed: PlacedObject, by: str | None, where: str) -> list[str]:
    """Return the attachments that the hand, or a tool `by`, can grasp, in the object's order.

    These are the ones made for it (`Attachment.contact`), or all if the object has none such.
    """
    check_graspable(placed, where)
    attachments = placed.object.attachments
    contact = "grasp" if by is None else "touch"
    made_for_it = [name for name, one in attachments.items() if one.contact == contact]
    return made_for_it or list(attachments)


def check_link(placed: PlacedObject, link: str, where: str) -> None:
    """Check that an object has a link."""
    if link not in placed.object.links:
        raise UnknownNameError(f"link of '{placed.name}'", link, placed.object.links, field=where)


def find_robot_frame(scene: Scene, name: str | None, where: str) -> str:
    """Return the name of a robot frame, by default the tool frame."""
    frame = name or scene.robot.tool_frame
    frames = scene.robot.frame_names
    if frame not in frames:
        raise UnknownNameError("frame of the robot", frame, frames, field=where)
    return frame


def find_path_joints(placed: PlacedObject, attachment: Attachment) -> list[str]:
    """Return the names of the joints from an object's base to an attachment's link."""
    model = placed.object.model
    frame = model.frames[model.getFrameId(attachment.link, pin.FrameType.BODY)]
    joint = frame.parentJoint
    names: list[str] = []
    while joint:
        names.insert(0, str(model.names[joint]))
        joint = model.parents[joint]
    return names


def find_joint_limits(placed: PlacedObject, coordinate: str) -> tuple[float, float]:
    """Return the limits of an object's coordinate `<object>.<joint>`, [rad] or [m]."""
    _, _, joint = coordinate.partition(".")
    index = placed.object.coordinates.names.index(joint)
    return float(placed.object.lower[index]), float(placed.object.upper[index])


def compute_openings(scene: Scene, phases: Sequence[Phase]) -> list[float | None]:
    """Return the gripper opening in each phase [m]; None: as in the robot's rest configuration.

    It is the opening of the attachment that the gripper holds or grasps next; after the last grasp
    it does not change.
    """
    next_holds = list[Hold | None]()
    hold = None
    for phase in reversed(phases):
        hold = find_gripper_hold((*phase.held, *phase.grasps)) or hold
        next_holds.insert(0, hold)
    openings = list[float | None]()
    opening = compute_start_opening(scene)
    for next_hold in next_holds:
        if next_hold is not None:
            opening = compute_grasp_opening(scene, next_hold)
        openings.append(opening)
    return openings
