"""Prepares an imported description for planning: names, fixed links, scale and axes."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.importing.description import MOVING_KINDS, Description, Joint, Link, Part
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.words import clean_name

if TYPE_CHECKING:
    import trimesh


Surfaces = Mapping[int, "trimesh.Trimesh"]
"""Surfaces of parts in the frame of their link, by `id` of the part."""
_UP = {"z": np.eye(3), "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])}


def find_multiple_objects(description: Description) -> tuple[str, ...]:
    """Return a note if a file holds several objects with joints of their own; else nothing.

    Several objects hang on a root without shapes, as in a scene file. If all of them are drawers
    that slide on it, they are one chest of drawers.
    """
    joints = description.joints
    root = description.root
    counts = dict[str, int]()  # of joints that are not fixed, by the link on the root
    for link in description.children().get(root, ()):
        count = sum(joints[child].kind != "fixed" for child in description.subtree(link))
        if count > 0:
            counts[link] = count
    has_base = bool(description.links[root].solid)
    are_drawers = all(joints[link].kind != "fixed" for link in counts)
    if len(counts) < 2 or has_base or are_drawers:
        return ()
    objects = list[str]()
    for link, count in counts.items():
        noun = "joint" if count == 1 else "joints"
        objects.append(f"'{link}' ({count} {noun})")
    listed = ", ".join(objects)
    return (
        f"the file holds several objects: {listed}; to import only one, name it (link, --link)",
    )


def choose_name(wanted: str, taken: set[str]) -> str:
    """Choose a name that scenes accept and that is not in `taken`, and add it to `taken`.

    Unprintable characters, ".", "/" and spaces become "_"; equal results are numbered.
    """
    stem = clean_name(wanted)
    name = stem
    number = 1
    while name in taken:
        number += 1
        name = f"{stem}_{number}"
    taken.add(name)
    return name


def rename_for_scenes(description: Description) -> Description:
    """Return the object with names of links and joints that scenes and steps accept."""
    links_taken = set[str]()
    joints_taken = set[str]()
    links = {name: choose_name(name, links_taken) for name in description.links}
    joints = {
        child: choose_name(joint.name, joints_taken) for child, joint in description.joints.items()
    }
    return description.rename(links, joints)


def fix_immovable_joints(description: Description) -> Description:
    """Return the object with those joints fixed that have one value or move no shape, each noted.

    They are fixed in their closed position. Floating joints stay, and end what a joint moves.
    """
    joints = dict(description.joints)
    notes = list(description.notes)
    closed_positions = find_closed_positions(description)
    for child, joint in description.joints.items():
        if joint.kind not in MOVING_KINDS:
            continue
        moved_names = collect_attached_links(description, child)
        moved_links = [description.links[name] for name in moved_names]
        if joint.limits is not None and joint.limits[0] == joint.limits[1]:
            notes.append(f"joint '{joint.name}' has a single value: fixed")
        elif not any(link.solid for link in moved_links):
            mass = sum(link.inertia.mass for link in moved_links)
            weight = f"; its {mass:.3g} kg move with link '{joint.parent}'" if mass > 0.0 else ""
            notes.append(f"joint '{joint.name}' moves no shape: fixed{weight}")
        else:
            continue
        joints[child] = joint.fix(closed_positions.get(joint.name, 0.0))
    return dataclasses.replace(description, joints=joints, notes=tuple(notes))


def collect_attached_links(description: Description, link: str) -> set[str]:
    """Return a link and those attached to it, without free objects."""
    found = description.subtree(link)
    for child, joint in description.joints.items():
        if child != link and child in found and joint.kind == "floating":
            found -= description.subtree(child)
    return found


def merge_fixed_links(description: Description) -> Description:
    """Return the object with fixed links merged into their parents, masses and inertias included.

    Joints with a single value, or that move no shape, become fixed before, and are noted.
    """
    description = fix_immovable_joints(description)
    links = dict(description.links)
    joints = dict(description.joints)
    children = description.children()
    for child in list(joints):
        joint = joints[child]
        if joint.kind != "fixed":
            continue
        parent = links[joint.parent]
        removed = links.pop(child)
        visual = _transform_parts(removed, removed.visual, joint.placement)
        collision = _transform_parts(removed, removed.collision, joint.placement)
        # If only one of them has collision shapes, the other collides with its visual ones.
        if bool(parent.collision) != bool(removed.collision):
            parent = dataclasses.replace(parent, collision=parent.solid)
            collision = collision or visual
        links[joint.parent] = Link(
            parent.name,
            (*parent.visual, *visual),
            (*parent.collision, *collision),
            parent.inertia + joint.placement.act(removed.inertia),
        )
        del joints[child]
        moved = [name for name in children.pop(child, ()) if name in joints]
        children[joint.parent] += moved
        for name in moved:
            placement = joint.placement * joints[name].placement
            joints[name] = dataclasses.replace(
                joints[name], parent=joint.parent, placement=placement
            )
    return dataclasses.replace(description, links=links, joints=joints)


def _transform_parts(link: Link, parts: tuple[Part, ...], placement: pin.SE3) -> tuple[Part, ...]:
    """Return the parts of a link in a frame in which the link is at `placement`."""
    moved = list[Part]()
    for part in parts:
        name = f"{link.name}_{part.name}".rstrip("_")
        moved.append(dataclasses.replace(part.transform(placement), name=name))
    return tuple(moved)


def load_surfaces(description: Description) -> Surfaces:
    """Return the surfaces of all visual and collision shapes."""
    surfaces: dict[int, trimesh.Trimesh] = {}
    for link in description.links.values():
        for part in (*link.visual, *link.collision):
            surfaces[id(part)] = part.make_mesh()
    return surfaces


def compute_bounds(
    description: Description, meshes: Surfaces, values: Mapping[str, float] | None = None
) -> tuple[Floats, Floats]:
    """Return the bounding box of the collision geometry in the root's frame [m]."""
    placements = description.compute_placements(values)
    points = place_vertices(description, meshes, placements, description.links)
    if not points:
        # They say what was left out.
        notes = "; ".join(description.notes[:3])
        raise InputError(
            "no shapes are left" if notes else "the file has no shapes",
            file=description.file,
            expected="<collision> or <visual> elements (URDF, SDF), or geoms (MJCF)",
            got=notes or None,
        )
    vertices = np.vstack(points)
    return vertices.min(axis=0), vertices.max(axis=0)


def place_vertices(
    description: Description,
    meshes: Surfaces,
    placements: Mapping[str, pin.SE3],
    links: Iterable[str],
) -> list[Floats]:
    """Return the vertices of the links' parts in the root's frame, shape (n, 3) [m] each."""
    placed = list[Floats]()
    for name in links:
        placement = placements[name]
        for part in description.links[name].solid:
            vertices = np.asarray(meshes[id(part)].vertices)
            placed.append(vertices @ placement.rotation.T + placement.translation)
    return placed


def find_closed_positions(description: Description) -> dict[str, float]:
    """Return the closed positions of joints, zero or the nearest limit, [rad] or [m]."""
    positions = dict[str, float]()
    for joint in description.joints.values():
        if joint.limits is not None:
            low, high = joint.limits
            positions[joint.name] = min(max(0.0, low), high)
    return positions


def scale_object(description: Description, factor: float) -> Description:
    """Scale an object: shapes, joint placements and prismatic limits; masses stay as stated."""
    links = dict[str, Link]()
    for name, link in description.links.items():
        visual = tuple(_scale_part(part, factor) for part in link.visual)
        collision = tuple(_scale_part(part, factor) for part in link.collision)
        # Moments of inertia grow with the square of lengths if the mass stays.
        inertia = pin.Inertia(
            link.inertia.mass, factor * link.inertia.lever, factor**2 * link.inertia.inertia
        )
        links[name] = Link(name, visual, collision, inertia)
    joints = {child: _scale_joint(joint, factor) for child, joint in description.joints.items()}
    return dataclasses.replace(description, links=links, joints=joints)


def _scale_part(part: Part, factor: float) -> Part:
    placement = _scale_placement(part.placement, factor)
    size = tuple(factor * length for length in part.size)
    return dataclasses.replace(part, placement=placement, size=size)


def _scale_joint(joint: Joint, factor: float) -> Joint:
    placement = _scale_placement(joint.placement, factor)
    if joint.kind != "prismatic":
        return dataclasses.replace(joint, placement=placement)
    limits = joint.limits
    if limits is not None:
        low, high = limits
        limits = (factor * low, factor * high)
    springref = joint.springref * factor
    return dataclasses.replace(joint, placement=placement, limits=limits, springref=springref)


def _scale_placement(placement: pin.SE3, factor: float) -> pin.SE3:
    return pin.SE3(placement.rotation, factor * placement.translation)


def make_upright(description: Description, up: str) -> Description:
    """Return the object rotated such that its axis `up`, "y" or "z", points upwards."""
    return move_root(description, pin.SE3(_UP[up], np.zeros(3)))


def move_root(description: Description, placement: pin.SE3) -> Description:
    """Return the object with its root's frame moved such that the old one is at `placement`."""
    root = description.root
    links = dict(description.links)
    links[root] = links[root].transform(placement)
    joints = dict(description.joints)
    for child, joint in description.joints.items():
        if joint.parent == root:
            joints[child] = dataclasses.replace(joint, placement=placement * joint.placement)
    return dataclasses.replace(description, links=links, joints=joints)
