"""Makes what a planner needs of what a file says: joints that move something, between limits, in metres, upright."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.importing.objects.description import Description, Link, Part
from vkc_pin.utils.arrays import Floats

if TYPE_CHECKING:
    import trimesh

__all__ = [
    "Surfaces",
    "add_missing_limits",
    "choose_name",
    "compute_bounds",
    "extract_subtree",
    "find_closed_positions",
    "find_multiple_objects",
    "load_surfaces",
    "make_upright",
    "merge_fixed_links",
    "move_root",
    "rename_for_scenes",
    "scale_object",
]

Surfaces = Mapping[int, "trimesh.Trimesh"]
"""The surfaces of parts in the frame of their link, by `id` of the part."""
_OPEN = np.pi / 2.0  # [rad]: how far a hinge opens whose limits nobody states
_HARDLY = 0.05  # [rad]: who meant degrees and wrote radians has hinges that turn by less
_PULLED = 0.8  # of the depth of a drawer: how far it slides then
_UP = {"z": np.eye(3), "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])}


def extract_subtree(description: Description, link: str) -> Description:
    """Return a link and all that hangs on it as an object of its own.

    Raises:
        UnknownNameError: There is no such link.
    """
    if link not in description.links:
        raise UnknownNameError("link", link, description.links, file=description.file, field="link")
    kept = description.subtree(link)
    links = {name: found for name, found in description.links.items() if name in kept}
    joints = {
        child: joint
        for child, joint in description.joints.items()
        if child in kept and child != link
    }
    return dataclasses.replace(description, links=links, joints=joints)


def find_multiple_objects(description: Description) -> tuple[str, ...]:
    """Return a note about a file that holds several things with joints of their own; none if it holds one.

    They stand on a root without shapes, as of a whole scene; drawers that slide on one, all of
    them, are one chest of drawers.
    """
    joints, root = description.joints, description.root
    hung = [child for child, joint in joints.items() if joint.parent == root]
    counts = {
        link: sum(joints[child].kind != "fixed" for child in description.subtree(link))
        for link in hung
    }
    things = {link: count for link, count in counts.items() if count}
    if (
        len(things) < 2
        or description.links[root].solid
        or all(joints[link].kind != "fixed" for link in things)
    ):
        return ()
    listed = ", ".join(
        f"'{link}' ({count} joint{'s' * (count != 1)})" for link, count in things.items()
    )
    return (
        f"several things hang on its root: {listed}; to import one of them, name it (link, --link)",
    )


def choose_name(wanted: str, taken: set[str]) -> str:
    """Choose a name that scenes accept and that is not in `taken`, and add it to `taken`.

    Characters that cannot be printed, ".", "/" and spaces become "_"; equal results are numbered.
    """
    plain = re.sub(r"[\s./]+", "_", wanted)
    stem = "".join(letter if letter.isprintable() else "_" for letter in plain).strip("_") or "part"
    name, number = stem, 1
    while name in taken:
        number += 1
        name = f"{stem}_{number}"
    taken.add(name)
    return name


def rename_for_scenes(description: Description) -> Description:
    """Return the object with names of links and joints that scenes and steps accept."""
    links_taken, joints_taken = set[str](), set[str]()
    names = {name: choose_name(name, links_taken) for name in description.links}
    links = {
        names[name]: dataclasses.replace(link, name=names[name])
        for name, link in description.links.items()
    }
    joints = {
        names[child]: dataclasses.replace(
            joint,
            name=choose_name(joint.name, joints_taken),
            parent=names[joint.parent],
            child=names[child],
        )
        for child, joint in description.joints.items()
    }
    return dataclasses.replace(description, links=links, joints=joints)


def merge_fixed_links(description: Description) -> Description:
    """Return the same object with every link a body that moves: fixed links become part of what they are fixed to.

    Links without any shape that nothing with a shape hangs on are left out, and noted. A joint with
    nowhere to go becomes fixed.
    """
    links, joints, notes = (
        dict(description.links),
        dict(description.joints),
        list(description.notes),
    )
    for child in list(joints):
        below = description.subtree(child)
        if not any(links[name].solid for name in below if name in links):
            notes.append(
                f"joint '{joints[child].name}' moves nothing that has a shape: left out with link '{child}'"
            )
            for name in below:
                links.pop(name, None)
                joints.pop(name, None)
    for child, joint in joints.items():
        if (
            joint.kind != "fixed"
            and joint.limits is not None
            and joint.limits[0] == joint.limits[1] != 0.0
        ):
            placement = joint.placement * joint.compute_motion(joint.limits[0])
            joints[child] = dataclasses.replace(joint, placement=placement, limits=(0.0, 0.0))
    for child in list(joints):
        joint = joints[child]
        stuck = joint.kind != "fixed" and joint.limits == (0.0, 0.0)
        if stuck:
            notes.append(f"joint '{joint.name}' has one value only: fixed")
        if joint.kind == "fixed" or stuck:
            above, gone = links[joint.parent], links.pop(child)
            moved = (
                _moved(gone, parts, joint.placement) for parts in (gone.visual, gone.collision)
            )
            visual, collision = moved
            if bool(above.collision) != bool(
                gone.collision
            ):  # one of them collides as what it looks like
                above, collision = (
                    dataclasses.replace(above, collision=above.solid),
                    collision or visual,
                )
            inertia = above.inertia + joint.placement.act(gone.inertia)
            links[joint.parent] = Link(
                above.name, (*above.visual, *visual), (*above.collision, *collision), inertia
            )
            del joints[child]
            for name, other in joints.items():
                if other.parent == child:
                    placement = joint.placement * other.placement
                    joints[name] = dataclasses.replace(
                        other, parent=joint.parent, placement=placement
                    )
    return dataclasses.replace(description, links=links, joints=joints, notes=tuple(notes))


def _moved(link: Link, parts: tuple[Part, ...], placement: pin.SE3) -> tuple[Part, ...]:
    return tuple(
        dataclasses.replace(
            part, name=f"{link.name}_{part.name}".rstrip("_"), placement=placement * part.placement
        )
        for part in parts
    )


def load_surfaces(description: Description) -> Surfaces:
    """Return the surfaces of all shapes, those that are seen and those that collide."""
    parts = [
        part for link in description.links.values() for part in (*link.visual, *link.collision)
    ]
    return {id(part): part.mesh() for part in parts}


def compute_bounds(
    description: Description, meshes: Surfaces, values: Mapping[str, float] | None = None
) -> tuple[Floats, Floats]:
    """Return the box around what collides, in the root's frame, [m], joints at `values` or at zero.

    Raises:
        InputError: Nothing has a shape.
    """
    places = description.compute_placements(values)
    points = [
        np.asarray(meshes[id(part)].vertices) @ places[name].rotation.T + places[name].translation
        for name, link in description.links.items()
        for part in link.solid
    ]
    if not points:
        raise InputError(
            "nothing in this file has a shape",
            file=description.file,
            expected="<collision> or <visual> elements",
        )
    joined = np.vstack(points)
    return joined.min(axis=0), joined.max(axis=0)


def find_closed_positions(description: Description) -> dict[str, float]:
    """Return the values at which joints are closed, zero or the limit next to it, [rad] or [m]."""
    return {
        joint.name: min(max(0.0, joint.limits[0]), joint.limits[1])
        for joint in description.joints.values()
        if joint.limits
    }


def scale_object(description: Description, factor: float) -> Description:
    """Return the object made larger by a factor: shapes, places of joints, and how far they slide; masses stay as stated."""
    links = {}
    for name, link in description.links.items():
        looks, solid = (
            tuple(_scaled(part, factor) for part in parts)
            for parts in (link.visual, link.collision)
        )
        inertia = pin.Inertia(
            link.inertia.mass, factor * link.inertia.lever, factor**2 * link.inertia.inertia
        )
        links[name] = Link(name, looks, solid, inertia)
    joints = {}
    for child, joint in description.joints.items():
        limits = joint.limits
        if joint.kind == "prismatic" and limits is not None:
            limits = (factor * limits[0], factor * limits[1])
        placement = pin.SE3(joint.placement.rotation, factor * joint.placement.translation)
        joints[child] = dataclasses.replace(joint, placement=placement, limits=limits)
    return dataclasses.replace(description, links=links, joints=joints)


def _scaled(part: Part, factor: float) -> Part:
    placement = pin.SE3(part.placement.rotation, factor * part.placement.translation)
    return dataclasses.replace(
        part, placement=placement, size=tuple(factor * size for size in part.size)
    )


def make_upright(description: Description, up: str) -> Description:
    """Return the object turned so that its axis `up`, "y" or "z", points upwards."""
    return move_root(description, pin.SE3(_UP[up], np.zeros(3)))


def move_root(description: Description, placement: pin.SE3) -> Description:
    """Return the object with its root's frame where the old one is at `placement`."""
    links, root = dict(description.links), description.root
    links[root] = links[root].transform(placement)
    joints = {
        child: dataclasses.replace(joint, placement=placement * joint.placement)
        if joint.parent == root
        else joint
        for child, joint in description.joints.items()
    }
    return dataclasses.replace(description, links=links, joints=joints)


def add_missing_limits(description: Description, meshes: Surfaces) -> Description:
    """Return the object with limits for hinges and slides that have none, each noted.

    A hinge opens by a right angle, a drawer by most of its depth, in the direction that brings what
    moves away from the middle of the object.
    """
    joints, notes = dict(description.joints), list(description.notes)
    places, (low, high) = description.compute_placements(), compute_bounds(description, meshes)
    for child, joint in description.joints.items():
        if joint.kind == "revolute" and joint.limits is not None and np.ptp(joint.limits) < _HARDLY:
            degrees = float(np.degrees(np.ptp(joint.limits)))
            unit = "are its limits in another unit (MJCF: `angle` of <compiler>)?"
            notes.append(f"joint '{joint.name}' turns by {degrees:.1g}° only: {unit}")
        if joint.kind not in ("revolute", "prismatic") or joint.limits is not None:
            continue
        below = description.subtree(child)
        points = np.vstack(
            [
                np.asarray(meshes[id(part)].vertices) @ places[name].rotation.T
                + places[name].translation
                for name in below
                for part in description.links[name].solid
            ]
        )
        centre, axis = (
            (points.min(axis=0) + points.max(axis=0)) / 2.0,
            places[child].rotation @ joint.axis,
        )
        way = (
            axis
            if joint.kind == "prismatic"
            else np.cross(axis, centre - places[child].translation)
        )
        sign = 1.0 if way @ (centre - (low + high) / 2.0) >= 0.0 else -1.0
        far = _OPEN if joint.kind == "revolute" else _PULLED * float(np.ptp(points @ axis))
        limits = (0.0, far) if sign > 0.0 else (-far, 0.0)
        joints[child] = dataclasses.replace(joint, limits=limits)
        unit = "rad" if joint.kind == "revolute" else "m"
        notes.append(
            f"joint '{joint.name}' states no limits: {limits[0]:.3g} to {limits[1]:.3g} {unit}, away from the middle"
        )
    return dataclasses.replace(description, joints=joints, notes=tuple(notes))
