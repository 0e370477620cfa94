"""What may be close to what, and for how long: the rules that the program and its independent check keep, each in its own way.

- A hand and the link it takes hold of keep `Options.grasp_clearance` for `EASED_TIME` before it is held and after. What is held
  through another link, and that link, need no clearance then.
- While it is held they move as one, unless the grasp leaves a freedom: then they keep the same.
- What is lifted, put down, or begins or ends a ride, and what is next to it there, may be as near as they are there for
  `EASED_TIME`. So may a link that touches something, and what is at that place.
- What rides and what it stands on move as one.
"""

from __future__ import annotations

from collections.abc import Collection

from vkc_pin.scene.hold import Hold
from vkc_pin.scene.scene import Scene

__all__ = ["CONTACT", "EASED_TIME", "grasped", "moves_as_one", "touching"]

CONTACT = 1e-4
"""Overlap that is contact: what stands on a table overlaps it by rounding [m]."""
EASED_TIME = 1.0
"""For how long before and after a contact shapes may be close; at `Options.dt` a waypoint [s]."""


def grasped(scene: Scene, hold: Hold) -> str:
    """Return the label of the link that a hold takes hold of, "<object>.<link>"."""
    return f"{hold.object}.{scene.objects[hold.object].object.attachments[hold.attachment].link}"


def touching(scene: Scene, hold: Hold) -> Collection[str]:
    """Return the labels of the links that take hold: the robot's touch links, or the link that something is held through."""
    return scene.robot.touch_links if hold.frame is None else (hold.frame,)


def moves_as_one(scene: Scene, hold: Hold) -> bool:
    """Return whether what holds does not move relative to what is grasped while it is held."""
    attachment = scene.objects[hold.object].object.attachments[hold.attachment]
    return attachment.firm or not attachment.freedoms
