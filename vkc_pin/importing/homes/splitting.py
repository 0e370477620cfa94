"""Cuts the tree of a home into what stands fixed, what can be opened, and what can be carried."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.importing.objects.clean_up import (
    compute_bounds,
    extract_subtree,
    find_closed_positions,
    load_surfaces,
    move_root,
)
from vkc_pin.importing.objects.description import Description, Joint, Link

__all__ = ["FLOOR_RISE", "Home", "Thing", "split_home"]

FLOOR_RISE = 0.02
"""What rises no higher above the floor is part of it [m]: slabs, carpets and thresholds, which wheels roll over."""
_BUILDING = 3.5  # [m]: what is longer is no piece of furniture but part of the building
_MOVING = ("revolute", "continuous", "prismatic")


@dataclass(frozen=True, eq=False)
class Thing:
    """Something that moves: furniture with its joints, or a thing to carry.

    Attributes:
        name: What it is called in the scene, as the link that it hangs on.
        description: Its links and joints. The axes of its root are the world's. The origin is below
            its middle, on the floor, or at the lowest point of what is carried.
        position: Of that origin in the world [m].
        free: Whether it can be carried away.
    """

    name: str
    description: Description
    position: tuple[float, float, float]
    free: bool


@dataclass(frozen=True, eq=False)
class Home:
    """A home that was taken apart.

    Attributes:
        building: Links that are longer than furniture, or the root, with their shapes in the world.
        furniture: Other links that stand fixed, with their shapes in the world.
        floor: Names of the shapes that are part of the floor.
        things: What moves.
        shapes: How many colliding shapes the file has.
        notes: What was changed or left out.
    """

    building: tuple[Link, ...]
    furniture: tuple[Link, ...]
    floor: tuple[str, ...]
    things: tuple[Thing, ...]
    shapes: int
    notes: tuple[str, ...]


def split_home(description: Description) -> Home:
    """Return what a home consists of.

    A link that stands fixed and has joints on it becomes one thing with all that moves on it. On
    links of the building, each joint starts a thing of its own, which has no shape that stands
    still: a door swings past walls as past anything else.

    Args:
        description: The home, with the floor at z = 0; names are those of scenes.
    """
    description = _unstuck(description)
    joints, notes = description.joints, list(description.notes)
    places, values = description.compute_placements(), find_closed_positions(description)
    now = description.compute_placements(values)
    free = [child for child, joint in joints.items() if joint.kind == "floating"]
    fixed = {description.root}
    while (
        grown := {
            child
            for child, joint in joints.items()
            if joint.kind == "fixed" and joint.parent in fixed
        }
        - fixed
    ):
        fixed |= grown
    building, furniture, floor, things = list[Link](), list[Link](), list[str](), list[Thing]()
    for name in (name for name in description.links if name in fixed):
        link = description.links[name].transform(places[name])
        moved = [
            child
            for child, joint in joints.items()
            if joint.parent == name and joint.kind in _MOVING
        ]
        large = name == description.root or _length(link) > _BUILDING
        if moved and not large:
            kept = {name}.union(*(_carried(description, child) for child in moved))
            things.append(_thing(name, _part(description, name, kept), places[name]))
            continue
        for child in moved:
            hung = _on_nothing(description, child)
            things.append(_thing(child, hung, places[name]))
        low = [part for part in link.solid if part.mesh().bounds[1, 2] <= FLOOR_RISE]
        floor += [part.name or name for part in low]
        solid = tuple(part for part in link.solid if not any(part is other for other in low))
        if solid:
            looks = link.visual if not low else ()
            (building if large else furniture).append(Link(name, looks, solid))
    for name in free:
        kept = _carried(description, name)
        if not any(description.links[link].solid for link in kept):
            notes.append(f"link '{name}' moves freely and has no shape: left out")
            continue
        part = _part(description, name, kept)
        stiff = dict(part.joints)
        for child, joint in part.joints.items():
            if joint.kind in _MOVING:
                placement = joint.placement * joint.compute_motion(values.get(joint.name, 0.0))
                stiff[child] = dataclasses.replace(
                    joint, kind="fixed", placement=placement, limits=None
                )
                notes.append(
                    f"joint '{joint.name}' belongs to '{name}', which is carried as it is: fixed"
                )
        things.append(_thing(name, dataclasses.replace(part, joints=stiff), now[name], free=True))
    shapes = sum(len(link.solid) for link in description.links.values())
    return Home(
        tuple(building), tuple(furniture), tuple(floor), tuple(things), shapes, tuple(notes)
    )


def _unstuck(description: Description) -> Description:
    """Return the home with joints fixed that have one value only, or move nothing that has a shape."""
    joints, notes = dict(description.joints), list(description.notes)
    for child, joint in description.joints.items():
        if joint.kind not in _MOVING:
            continue
        stuck = joint.limits is not None and joint.limits[0] == joint.limits[1]
        if stuck or not any(description.links[link].solid for link in description.subtree(child)):
            notes.append(
                f"joint '{joint.name}' {'has one value only' if stuck else 'moves nothing that has a shape'}: fixed"
            )
            placement = joint.placement * joint.compute_motion(
                joint.limits[0] if stuck and joint.limits else 0.0
            )
            joints[child] = dataclasses.replace(
                joint, kind="fixed", placement=placement, limits=None
            )
    return dataclasses.replace(description, joints=joints, notes=tuple(notes))


def _carried(description: Description, link: str) -> set[str]:
    """Return a link and what hangs on it, without what moves freely."""
    found = description.subtree(link)
    for child, joint in description.joints.items():
        if child != link and child in found and joint.kind == "floating":
            found -= description.subtree(child)
    return found


def _part(description: Description, root: str, kept: Collection[str]) -> Description:
    """Return some links and the joints between them as a description, whose notes begin anew."""
    part = extract_subtree(description, root)
    links = {name: link for name, link in part.links.items() if name in kept}
    return Description(
        description.file,
        links,
        {child: joint for child, joint in part.joints.items() if child in kept},
    )


def _on_nothing(description: Description, child: str) -> Description:
    """Return what a joint moves, with that joint, on a link without shapes."""
    part, base = _part(description, child, _carried(description, child)), f"{child}_base"
    while base in description.links:
        base += "_"
    joint: Joint = dataclasses.replace(description.joints[child], parent=base)
    return Description(
        description.file, {base: Link(base), **part.links}, {child: joint, **part.joints}
    )


def _thing(name: str, description: Description, place: pin.SE3, *, free: bool = False) -> Thing:
    """Return a thing whose root is at a place in the world."""
    inside = move_root(description, place)
    low, high = compute_bounds(inside, load_surfaces(inside), find_closed_positions(inside))
    x, y = ((low + high) / 2.0).round(6)[:2].tolist()
    z = float(low[2].round(6)) if free else 0.0
    return Thing(name, move_root(inside, pin.SE3(np.eye(3), -np.array([x, y, z]))), (x, y, z), free)


def _length(link: Link) -> float:
    """Return how long a link is on the floor [m]; 0 without shapes."""
    if not link.solid:
        return 0.0
    boxes = np.array([part.mesh().bounds for part in link.solid])
    return float((boxes[:, 1].max(axis=0) - boxes[:, 0].min(axis=0))[:2].max())
