"""What a robot holds at the start: whether that fits the objects, and where it puts them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.geometry import PlacedObject, within_limits
from vkc_pin.hold import holds_of

__all__ = ["check_holds", "in_hand"]


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
