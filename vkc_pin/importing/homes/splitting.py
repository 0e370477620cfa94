"""Divides the tree of a home into fixed parts, articulated objects and free objects."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.importing.description import MOVING_KINDS, Description, Joint, Link
from vkc_pin.importing.objects.clean_up import (
    collect_attached_links,
    compute_bounds,
    find_closed_positions,
    fix_immovable_joints,
    load_surfaces,
    move_root,
)
from vkc_pin.utils.arrays import Floats

FLOOR_RISE = 0.02
"""Height up to which shapes are part of the floor [m]: slabs, carpets and thresholds."""
_FLOOR_BEYOND = 2.0  # [m] of floor on sides without walls: a robot's length, and an arm's
_WALL_HEIGHT = 0.5  # [m] at which walls are found, below windows
_WALL_DEPTH = 0.5  # [m] from the side of the home within which walls belong to the side
_BUILDING = 3.5  # [m] length above which a link is part of the building, not furniture


@dataclass(frozen=True, eq=False)
class HomeObject:
    """A movable object of a home: furniture with joints, or a free object.

    Attributes:
        name: Name in the scene, that of its root link in the file.
        description: Links and joints. The root's axes are the world's. The origin is below the
            centre, on the floor, or at the lowest point of a free object.
        position: Origin in the world [m].
        free: Whether it can be carried.
    """

    name: str
    description: Description
    position: tuple[float, float, float]
    free: bool


@dataclass(frozen=True, eq=False)
class Home:
    """A home, divided into its parts.

    Attributes:
        building: Links longer than furniture, or the root, with shapes in the world frame.
        furniture: Other fixed links, with shapes in the world frame.
        floor: Names of the shapes that are part of the floor.
        objects: Movable objects.
        shapes: Number of collision shapes in the file.
        notes: Changes and omissions.
    """

    building: tuple[Link, ...]
    furniture: tuple[Link, ...]
    floor: tuple[str, ...]
    objects: tuple[HomeObject, ...]
    shapes: int
    notes: tuple[str, ...]


def split_home(description: Description) -> Home:
    """Divide a home into its parts.

    A fixed link with joints becomes one object with everything that moves on it. On links of the
    building, each joint starts an object of its own, without fixed shapes: doors may swing past
    walls.
    """
    description = fix_immovable_joints(description)
    joints, notes = description.joints, list(description.notes)
    places, values = description.compute_placements(), find_closed_positions(description)
    current_placements = description.compute_placements(values)
    free = [child for child, joint in joints.items() if joint.kind == "floating"]
    fixed = {description.root}
    while (
        added := {
            child
            for child, joint in joints.items()
            if joint.kind == "fixed" and joint.parent in fixed
        }
        - fixed
    ):
        fixed |= added
    building, furniture = list[Link](), list[Link]()
    floor, objects = list[str](), list[HomeObject]()
    for name in (name for name in description.links if name in fixed):
        link = description.links[name].transform(places[name])
        children = [
            child
            for child, joint in joints.items()
            if joint.parent == name and joint.kind in MOVING_KINDS
        ]
        large = name == description.root or _measure_length(link) > _BUILDING
        if children and not large:
            attached = (collect_attached_links(description, child) for child in children)
            part = _extract_links(description, name, {name}.union(*attached))
            objects.append(_place_object(name, part, places[name]))
            continue
        for child in children:
            part = _add_empty_base(description, child)
            objects.append(_place_object(child, part, places[name]))
        low = [part for part in link.solid if part.make_mesh().bounds[1, 2] <= FLOOR_RISE]
        floor += [part.name or name for part in low]
        solid = tuple(part for part in link.solid if not any(part is other for other in low))
        if solid:
            visual = link.visual if not low else ()
            (building if large else furniture).append(Link(name, visual, solid))
    for name in free:
        links_of_object = collect_attached_links(description, name)
        if not any(description.links[link].solid for link in links_of_object):
            notes.append(f"link '{name}' is free and has no shape: left out")
            continue
        part = _extract_links(description, name, links_of_object)
        fixed_joints = dict(part.joints)
        for child, joint in part.joints.items():
            if joint.kind in MOVING_KINDS:
                fixed_joints[child] = joint.fix(values.get(joint.name, 0.0))
                notes.append(f"joint '{joint.name}' belongs to the free object '{name}': fixed")
        rigid = dataclasses.replace(part, joints=fixed_joints)
        objects.append(_place_object(name, rigid, current_placements[name], free=True))
    shapes = sum(len(link.solid) for link in description.links.values())
    return Home(
        tuple(building), tuple(furniture), tuple(floor), tuple(objects), shapes, tuple(notes)
    )


def add_floor(home: Home, low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """Return a box around a home with 2 m of floor beyond the sides without walls.

    A side has walls if those of the building cover at least half of its length. A wall is near the
    side and faces the inside: a solid that fills the home from side to side is none.

    Args:
        home: The home.
        low: Lower corner of its bounding box, shape (3,) [m].
        high: Upper corner of its bounding box, shape (3,) [m].
    """
    from trimesh.intersections import mesh_plane

    up, origin = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, _WALL_HEIGHT])
    sections, normals = [np.zeros((0, 2, 3))], [np.zeros((0, 3))]
    for part in (part for link in home.building for part in link.solid):
        mesh = part.make_mesh()
        cut, faces = mesh_plane(mesh, up, origin, return_faces=True)
        sections.append(np.asarray(cut).reshape(-1, 2, 3))
        # An open surface is a wall of both sides.
        normals.append(mesh.face_normals[faces] if mesh.is_watertight else np.zeros((len(cut), 3)))
    lines, outward = np.concatenate(sections), np.concatenate(normals)
    beyond = np.zeros((2, 3))
    for axis, side in itertools.product((0, 1), (0, 1)):
        depth = min(_WALL_DEPTH, 0.5 * float((high - low)[axis]))
        distance = np.abs(lines[:, :, axis] - (low, high)[side][axis]).max(axis=1)
        inward = (1.0, -1.0)[side] * outward[:, axis] >= 0.0
        is_wall = inward & (distance < depth)
        along = np.sort(lines[is_wall][:, :, 1 - axis], axis=1)
        covered, reached = 0.0, -np.inf
        for start, end in sorted(map(tuple, along)):
            covered += max(0.0, end - max(start, reached))
            reached = max(reached, end)
        if covered < 0.5 * (high - low)[1 - axis]:
            beyond[side, axis] = _FLOOR_BEYOND
    return low - beyond[0], high + beyond[1]


def _extract_links(
    description: Description, root: str, links_of_object: Collection[str]
) -> Description:
    """Return some links and the joints between them as a description without notes."""
    part = description.extract_subtree(root)
    links = {name: link for name, link in part.links.items() if name in links_of_object}
    return Description(
        description.file,
        links,
        {child: joint for child, joint in part.joints.items() if child in links_of_object},
    )


def _add_empty_base(description: Description, child: str) -> Description:
    """Return the subtree of a joint, including the joint, on a base link without shapes."""
    part = _extract_links(description, child, collect_attached_links(description, child))
    base = f"{child}_base"
    while base in description.links:
        base += "_"
    joint: Joint = dataclasses.replace(description.joints[child], parent=base)
    return Description(
        description.file, {base: Link(base), **part.links}, {child: joint, **part.joints}
    )


def _place_object(
    name: str, description: Description, place: pin.SE3, *, free: bool = False
) -> HomeObject:
    """Return an object whose root is at `place` in the world."""
    inside = move_root(_remove_prefix(description, f"{name}::"), place)
    low, high = compute_bounds(inside, load_surfaces(inside), find_closed_positions(inside))
    x, y = ((low + high) / 2.0).round(6)[:2].tolist()
    z = float(low[2].round(6)) if free else 0.0
    return HomeObject(
        name, move_root(inside, pin.SE3(np.eye(3), -np.array([x, y, z]))), (x, y, z), free
    )


def _remove_prefix(description: Description, prefix: str) -> Description:
    """Return an object without a prefix of names, as models of SDF worlds have it."""
    names = {name: name.removeprefix(prefix) for name in description.links}
    if len(set(names.values())) < len(names):
        return description
    joints = {child: joint.name.removeprefix(prefix) for child, joint in description.joints.items()}
    return description.rename(names, joints)


def _measure_length(link: Link) -> float:
    """Return the horizontal length of a link [m]; 0 without shapes."""
    if not link.solid:
        return 0.0
    boxes = np.array([part.make_mesh().bounds for part in link.solid])
    return float((boxes[:, 1].max(axis=0) - boxes[:, 0].min(axis=0))[:2].max())
