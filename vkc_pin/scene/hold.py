"""Holds: what is held, where and through what, whether that fits the objects, and where it puts them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.models.shapes import within_limits
from vkc_pin.scene.placed import PlacedObject

__all__ = ["Hold", "as_mappings", "check_holds", "holds_of", "in_hand"]


@dataclass(frozen=True)
class Hold:
    """One object held at one of its attachments, by the robot's tool or through another object that is held.

    Attributes:
        object: Its name in the scene.
        attachment: Where it is held.
        by: The hold of the object that it is held through (a stick); None: the robot's tool holds it.
        link: The link of that object which takes the place of the tool frame.
    """

    object: str
    attachment: str
    by: Hold | None = None
    link: str | None = None

    @property
    def frame(self) -> str | None:
        """The frame that holds it, "<object>.<link>"; None is the tool frame."""
        return f"{self.by.object}.{self.link}" if self.by else None

    def __str__(self) -> str:
        return f"{self.object}.{self.attachment}" + (f" by {self.frame}" if self.by else "")


def holds_of(held: Mapping[str, str], by: Mapping[str, str]) -> tuple[Hold, ...]:
    """Return the holds that two mappings describe, each after the one it depends on.

    Args:
        held: Object → attachment.
        by: Object → "<object>.<link>", for what is not held by the tool itself.

    Raises:
        UnknownNameError: `by` names an object that is not held.
        InputError: Objects hold each other in a circle, or `by` is not of that form.
    """
    found: dict[str, Hold] = {}
    for frame in by.values():
        owner, dot, link = str(frame).partition(".")
        if not (dot and link):
            raise InputError("not a link of an object", field="by", expected="<object>.<link>, e.g. stick.tip", got=repr(frame))
        if owner not in held:
            raise UnknownNameError("held object", owner, held, field="by")
    waiting = dict(held)
    while waiting:
        ready = [name for name in waiting if name not in by or by[name].partition(".")[0] in found]
        if not ready:
            raise InputError("objects hold each other in a circle", field="by", got=", ".join(sorted(waiting)))
        for name in ready:
            owner, _, link = by.get(name, "").partition(".")
            found[name] = Hold(name, waiting.pop(name), found[owner] if owner else None, link or None)
    return tuple(found.values())


def as_mappings(holds: Iterable[Hold]) -> tuple[dict[str, str], dict[str, str]]:
    """Return object → attachment, and object → holding frame for what the tool does not hold itself."""
    holds = tuple(holds)
    return {h.object: h.attachment for h in holds}, {h.object: h.frame for h in holds if h.frame is not None}


def check_holds(
    objects: Mapping[str, PlacedObject],
    held: Mapping[str, str],
    by: Mapping[str, str],
    at: Mapping[str, Sequence[float]],
) -> None:
    """Check that what is said to be held fits the objects; see `Scene.with_held`.

    Raises:
        UnknownNameError: There is no such object, attachment or link.
        InputError: Values that do not fit the attachment's freedoms, or objects that hold each other.
    """
    for name, attachment in held.items():
        if name not in objects:
            raise UnknownNameError("object", name, objects, field="held")
        freedoms = objects[name].object.attachment(attachment).freedoms
        values = at.get(name, (0.0,) * len(freedoms))
        if len(values) != len(freedoms):
            raise InputError(
                "wrong number of values", field=f"held.{name}.at", expected=f"{len(freedoms)}, one a freedom", got=len(values)
            )
        for value, freedom in zip(values, freedoms, strict=True):
            within_limits(value, freedom.lower, freedom.upper, f"held.{name}.at")
    for field_name, names in (("by", by), ("at", at)):
        for name in names:
            if name not in held:
                raise UnknownNameError("held object", name, held, field=field_name)
    for hold in holds_of(held, by):
        if hold.by is not None:
            objects[hold.by.object].link_placement(str(hold.link))
            if not (objects[hold.object].object.free and objects[hold.by.object].object.free):
                problem = "only a free object can be held through another, and only through a free one"
                raise InputError(problem, field=f"held.{hold.object}.by", got=hold.frame)


def in_hand(
    objects: Mapping[str, PlacedObject],
    tool: Callable[[], pin.SE3],
    held: Mapping[str, str],
    by: Mapping[str, str],
    at: Mapping[str, Sequence[float]],
) -> Mapping[str, PlacedObject]:
    """Return the objects with every free one that is held placed where it is held.

    Args:
        objects: By name.
        tool: Returns the placement of the tool frame in the world.
        held: Object → attachment.
        by: Object → "<object>.<link>", for what is held through another object.
        at: Object → values of its attachment's freedoms; zero where nothing is said.
    """
    placed = dict(objects)
    for hold in holds_of(held, by):
        one = placed[hold.object]
        if one.object.free:
            grasp = one.object.attachment(hold.attachment)
            values = at.get(hold.object) or (0.0,) * len(grasp.freedoms)
            in_object = one.object.link_placement(grasp.link, one.state) * grasp.tool(values)
            holder = placed[hold.by.object].link_placement(str(hold.link)) if hold.by else tool()
            placed[hold.object] = dataclasses.replace(one, placement=holder * in_object.inverse())
    return MappingProxyType(placed)
