"""What may be close to what, and for how long: the rules that the program and its independent check keep, each in its own way.

- A hand keeps the attachment's clearance from the whole object that it takes hold of, for
  `CONTACT_WINDOW` before it is held, as long as it is held, and for `CONTACT_WINDOW` after. Without a
  clearance of its own that is `Options.grasp_clearance`. What is held through another link, and
  that link, need none.
- The hand and the link that it holds move as one, unless the grasp leaves a freedom.
- A hand that pushes touches the link with its foremost point. It needs no clearance from that link,
  overlaps it nowhere, and moves it ahead of it only.
- What is lifted, put down, or begins or ends a ride, and what is next to it there, may be as near
  as they are there for `CONTACT_WINDOW`. So may a link that touches something, and what is at that
  place.
- What rides and what it stands on move as one.
- Shapes of articulated objects that are closer than `Options.dist_safe` to other fixed shapes, at
  the start or with all joints at zero, keep no clearance until their joints have taken them so far
  apart. They overlap only if they did there, and no deeper than one joint alone takes them; see
  `neighbours`.
- What a free object stands in where it is lifted for the first time, it may leave within
  `CONTACT_WINDOW`.
- What is in the hand at the start is lifted there: what it is next to, or in, it may leave within
  `CONTACT_WINDOW`.
- What the scene allows keeps the margin that the scene says, or none; see `Scene.allowed`.

The gripper is as far open as the attachment says that it holds, or comes to next; it opens and
closes where something is grasped or let go, and before the motion. Afterwards it stays as it is.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable

import pinocchio as pin

from vkc_pin.options import Options
from vkc_pin.world.models.articulated_object import Attachment
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.scene.clearance_exemptions import CONTACT_DEPTH
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene

__all__ = [
    "CONTACT_DEPTH",
    "CONTACT_WINDOW",
    "compute_grasp_opening",
    "compute_hand_clearance",
    "compute_hand_frame",
    "compute_start_opening",
    "find_grasped_link",
    "find_gripper_hold",
    "find_touch_links",
    "is_rigid_grasp",
]

CONTACT_WINDOW = 1.0
"""For how long before and after a contact shapes may be close; at `Options.dt` a waypoint [s]."""


def find_grasped_link(scene: Scene, hold: Hold) -> str:
    """Return the label of the link that a hold takes hold of, "<object>.<link>"."""
    return f"{hold.object}.{scene.objects[hold.object].object.attachments[hold.attachment].link}"


def find_touch_links(scene: Scene, hold: Hold) -> Collection[str]:
    """Return the labels of the links that take hold: the robot's touch links, or the link that something is held through."""
    return scene.robot.touch_links if hold.frame is None else (hold.frame,)


def compute_hand_clearance(scene: Scene, hold: Hold, link: str, options: Options) -> float:
    """Return what the links that take hold keep from a link of what they take hold of, near the grasp and while it lasts [m].

    Args:
        scene: Whose objects they are.
        hold: The hold.
        link: The link of its object, "<object>.<link>".
        options: Clearances where the attachment has none of its own.
    """
    attachment = scene.objects[hold.object].object.attachments[hold.attachment]
    if (hold.by or attachment.contact == "push") and link == find_grasped_link(scene, hold):
        return 0.0
    return min(
        options.grasp_clearance if attachment.clearance is None else attachment.clearance,
        options.dist_safe,
    )


def compute_hand_frame(robot: Robot, attachment: Attachment) -> pin.SE3:
    """Return what of the hand is brought to an attachment, in the tool frame: that itself, or the foremost point that pushes."""
    return (
        robot.opened(robot.opening(attachment.opening)).front
        if attachment.contact == "push"
        else pin.SE3.Identity()
    )


def is_rigid_grasp(scene: Scene, hold: Hold) -> bool:
    """Return whether what holds does not move relative to what is grasped while it is held."""
    attachment = scene.objects[hold.object].object.attachments[hold.attachment]
    return attachment.contact != "push" and (attachment.firm or not attachment.freedoms)


def find_gripper_hold(holds: Iterable[Hold]) -> Hold | None:
    """Return what the gripper itself holds; what is held through that does not matter to it."""
    return next((hold for hold in holds if hold.by is None), None)


def compute_grasp_opening(scene: Scene, hold: Hold) -> float | None:
    """Return how far the robot's gripper is open when it takes, or has, what it holds [m]; None: as at rest."""
    return scene.robot.opening(
        scene.objects[hold.object].object.attachments[hold.attachment].opening
    )


def compute_start_opening(scene: Scene) -> float | None:
    """Return how far the gripper is open at a scene's start [m]; None: as at rest."""
    hold = find_gripper_hold(scene.holds)
    return (
        scene.robot.opening(scene.opening) if hold is None else compute_grasp_opening(scene, hold)
    )
