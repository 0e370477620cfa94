"""Divides the tree of a home into fixed parts, articulated objects and free objects."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.importing.description import MOVING_KINDS, Description, Link, Part
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
BUILDING = 3.5
"""Length above which a link is part of the building, not furniture [m]."""
_FLOOR_BEYOND = 2.0  # [m] of floor on sides without walls: a robot's length, and an arm's
_WALL_HEIGHT = 0.5  # [m] at which walls are found, below windows
_WALL_DEPTH = 0.5  # [m] from the side of the home within which walls belong to the side


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
    return _Splitter(fix_immovable_joints(description)).split()


class _Splitter:
    """Collects the parts of a home.

    Args:
        description: The home, with joints that move shapes only.
    """

    def __init__(self, description: Description) -> None:
        self._description = description
        self._children = description.children()
        self._notes = list(description.notes)
        self._building = list[Link]()
        self._furniture = list[Link]()
        self._floor = list[str]()
        self._objects = list[HomeObject]()

    def split(self) -> Home:
        """Return the home, divided into its parts."""
        description = self._description
        placements = description.compute_placements()
        for name in description.links:
            if description.is_fixed(name):
                self._add_fixed_link(name, placements[name])
        closed = find_closed_positions(description)
        closed_placements = description.compute_placements(closed)
        for child, joint in description.joints.items():
            if joint.kind == "floating":
                self._add_free_object(child, closed_placements[child], closed)
        return Home(
            building=tuple(self._building),
            furniture=tuple(self._furniture),
            floor=tuple(self._floor),
            objects=tuple(self._objects),
            shapes=sum(len(link.solid) for link in description.links.values()),
            notes=tuple(self._notes),
        )

    def _add_fixed_link(self, name: str, placement: pin.SE3) -> None:
        """Add a fixed link as furniture or part of the building, and objects of its joints."""
        description = self._description
        link = description.links[name].transform(placement)
        children = list[str]()
        for child in self._children.get(name, ()):
            if description.joints[child].kind in MOVING_KINDS:
                children.append(child)
        is_building = name == description.root or _measure_length(link) > BUILDING
        if children and not is_building:
            attached = {name}
            for child in children:
                attached |= collect_attached_links(description, child)
            part = _extract_links(description, name, attached)
            self._objects.append(_place_object(name, part, placement))
            return
        for child in children:
            part = _add_empty_base(description, child)
            self._objects.append(_place_object(child, part, placement))
        solid = list[Part]()
        for shape in link.solid:
            if shape.make_mesh().bounds[1, 2] <= FLOOR_RISE:
                self._floor.append(shape.name or name)
            else:
                solid.append(shape)
        if solid:
            # Visual shapes are not divided into floor and others.
            has_floor = len(solid) < len(link.solid)
            visual = () if has_floor else link.visual
            parts = self._building if is_building else self._furniture
            parts.append(Link(name, visual, tuple(solid)))

    def _add_free_object(
        self, name: str, placement: pin.SE3, positions: Mapping[str, float]
    ) -> None:
        """Add a free object, whose joints are fixed at `positions`."""
        description = self._description
        attached = collect_attached_links(description, name)
        if not any(description.links[link].solid for link in attached):
            self._notes.append(f"link '{name}' is free and has no shape: left out")
            return
        part = _extract_links(description, name, attached)
        joints = dict(part.joints)
        for child, joint in part.joints.items():
            if joint.kind in MOVING_KINDS:
                joints[child] = joint.fix(positions.get(joint.name, 0.0))
                about = f"belongs to the free object '{name}'"
                self._notes.append(f"joint '{joint.name}' {about}: fixed")
        rigid = dataclasses.replace(part, joints=joints)
        self._objects.append(_place_object(name, rigid, placement, free=True))


def add_floor(home: Home, low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """Return a box around a home with 2 m of floor beyond the sides without walls.

    A side has walls if those of the building cover at least half of its length. A wall is near the
    side and faces the inside: a solid that fills the home from side to side is none.

    Args:
        home: The home.
        low: Lower corner of its bounding box, shape (3,) [m].
        high: Upper corner of its bounding box, shape (3,) [m].
    """
    lines, outward = _cut_walls(home)
    size = high - low
    beyond = np.zeros((2, 3))
    for axis in (0, 1):
        depth = min(_WALL_DEPTH, 0.5 * float(size[axis]))
        other_axis = 1 - axis
        # Of each side: its number, a corner on it, and the sign of the direction inwards
        for side, corner, inward in ((0, low, 1.0), (1, high, -1.0)):
            distance = np.abs(lines[:, :, axis] - corner[axis]).max(axis=1)
            faces_inside = inward * outward[:, axis] >= 0.0
            is_wall = faces_inside & (distance < depth)
            along = np.sort(lines[is_wall][:, :, other_axis], axis=1)
            if _measure_union(along) < 0.5 * size[other_axis]:
                beyond[side, axis] = _FLOOR_BEYOND
    return low - beyond[0], high + beyond[1]


def _cut_walls(home: Home) -> tuple[Floats, Floats]:
    """Return the lines in which the building meets a horizontal plane, and their normals.

    Lines have shape (n, 2, 3) [m], outward normals of their faces shape (n, 3): zero for an open
    surface, which is a wall of both sides.
    """
    from trimesh.intersections import mesh_plane

    up = np.array([0.0, 0.0, 1.0])
    origin = np.array([0.0, 0.0, _WALL_HEIGHT])
    lines = [np.zeros((0, 2, 3))]
    normals = [np.zeros((0, 3))]
    for link in home.building:
        for part in link.solid:
            mesh = part.make_mesh()
            cut, faces = mesh_plane(mesh, up, origin, return_faces=True)
            lines.append(np.asarray(cut).reshape(-1, 2, 3))
            outward = mesh.face_normals[faces] if mesh.is_watertight else np.zeros((len(cut), 3))
            normals.append(outward)
    return np.concatenate(lines), np.concatenate(normals)


def _measure_union(intervals: Floats) -> float:
    """Return the length that intervals, shape (n, 2), cover together."""
    covered = 0.0
    reached = -np.inf
    for start, end in sorted(map(tuple, intervals)):
        covered += max(0.0, end - max(start, reached))
        reached = max(reached, end)
    return covered


def _extract_links(
    description: Description, root: str, links_of_object: Collection[str]
) -> Description:
    """Return some links and the joints between them as a description without notes."""
    part = description.extract_subtree(root)
    links = {name: link for name, link in part.links.items() if name in links_of_object}
    joints = {child: joint for child, joint in part.joints.items() if child in links_of_object}
    return Description(description.file, links, joints)


def _add_empty_base(description: Description, child: str) -> Description:
    """Return the subtree of a joint, including the joint, on a base link without shapes."""
    part = _extract_links(description, child, collect_attached_links(description, child))
    base = f"{child}_base"
    while base in description.links:
        base += "_"
    joint = dataclasses.replace(description.joints[child], parent=base)
    links = {base: Link(base), **part.links}
    joints = {child: joint, **part.joints}
    return Description(description.file, links, joints)


def _place_object(
    name: str, description: Description, place: pin.SE3, *, free: bool = False
) -> HomeObject:
    """Return an object whose root is at `place` in the world."""
    in_world = move_root(_remove_prefix(description, f"{name}::"), place)
    closed = find_closed_positions(in_world)
    low, high = compute_bounds(in_world, load_surfaces(in_world), closed)
    x, y = ((low + high) / 2.0).round(6)[:2].tolist()
    z = float(low[2].round(6)) if free else 0.0
    to_origin = pin.SE3(np.eye(3), -np.array([x, y, z]))
    return HomeObject(name, move_root(in_world, to_origin), (x, y, z), free)


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
