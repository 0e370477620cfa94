"""Reads a room that is one mesh, such as a scan: its floor, walls and furniture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.importing.description import Description, Joint, Link, Part
from vkc_pin.importing.homes.splitting import BUILDING, FLOOR_RISE
from vkc_pin.utils.arrays import Bools, Ints
from vkc_pin.world.files.meshes import load_mesh

if TYPE_CHECKING:
    import trimesh

MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl", ".off", ".dae")
"""Suffixes of meshes that are read as rooms."""
_MOST_TRIANGLES = 2_000_000
_ROOT = "room"
_LEVEL = float(np.cos(np.radians(20.0)))  # of a face's normal, along z: noisy floors are uneven
_SLICE = 0.04  # [m] within which the faces of one floor lie


def read_mesh_room(file: Path, floor: float | None = None) -> tuple[Description, float]:
    """Return a room that is one mesh, and the height of its floor.

    Faces up to `FLOOR_RISE` above the floor belong to it. The rest falls into connected surfaces:
    the root has those that are as long as a building, such as walls, and a link each has another
    one. z points up, to which glTF is turned as its specification says.

    Args:
        file: A mesh file in [m]; see `load_mesh`.
        floor: Height of the floor in the file [m]. Default: that of most horizontal area in the
            lower half of the room.

    Raises:
        InputError: The file cannot be read, or has no floor.
    """
    mesh = load_mesh(file)
    if len(mesh.faces) > _MOST_TRIANGLES:
        raise InputError(
            "the mesh is too large",
            file=file,
            expected=f"at most {_MOST_TRIANGLES} triangles",
            got=len(mesh.faces),
        )
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    notes = list[str]()
    if floor is None:
        floor = _find_floor(mesh, file)
        notes.append(f"the floor was found at the height {floor:.3f} m of the file (`floor`)")
    is_floor = mesh.triangles[:, :, 2].max(axis=1) <= floor + FLOOR_RISE
    surfaces = _split(mesh, ~is_floor)
    if not surfaces:
        raise InputError(
            "the room has nothing but a floor",
            file=file,
            field="floor",
            expected="surfaces above it",
            got=round(floor, 3),
        )
    building = list[Part]()
    if is_floor.any():
        building.append(Part.from_triangles("floor", _extract(mesh, np.flatnonzero(is_floor))))
    links = dict[str, Link]()
    joints = dict[str, Joint]()
    for number, surface in enumerate(surfaces):
        if surface.extents[:2].max() > BUILDING:
            building.append(Part.from_triangles(f"walls_{number}", surface))
            continue
        name = f"furniture_{number}"
        links[name] = Link(name, collision=(Part.from_triangles(name, surface),))
        joints[name] = Joint(
            name=name, kind="fixed", parent=_ROOT, child=name, placement=pin.SE3.Identity()
        )
    root = Link(_ROOT, collision=tuple(building))
    return Description(file, {_ROOT: root, **links}, joints, tuple(notes), format="mesh"), floor


def _find_floor(mesh: trimesh.Trimesh, file: Path) -> float:
    """Return the mean height of the slice with most horizontal area, in the lower half [m]."""
    heights = mesh.triangles_center[:, 2]
    low, high = mesh.bounds[:, 2]
    is_level = np.abs(mesh.face_normals[:, 2]) >= _LEVEL
    candidates = np.flatnonzero(is_level & (heights <= (low + high) / 2.0))
    if not len(candidates):
        raise InputError(
            "the mesh has no floor",
            file=file,
            field="floor",
            expected="horizontal faces in its lower half (z points up), or the height of the floor",
        )
    order = candidates[np.argsort(heights[candidates])]
    areas = np.concatenate([[0.0], np.cumsum(mesh.area_faces[order])])
    ends = np.searchsorted(heights[order], heights[order] + _SLICE, side="right")
    first = int(np.argmax(areas[ends] - areas[:-1]))
    inside = order[first : ends[first]]
    return float(np.average(heights[inside], weights=mesh.area_faces[inside]))


def _split(mesh: trimesh.Trimesh, is_kept: Bools) -> list[trimesh.Trimesh]:
    """Return the connected surfaces of some faces, the largest first."""
    from trimesh.graph import connected_component_labels

    kept = np.flatnonzero(is_kept)
    corners = mesh.faces[kept]
    # Faces that share a vertex are connected.
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]]])
    label_by_vertex = connected_component_labels(edges, node_count=len(mesh.vertices))
    labels = label_by_vertex[corners[:, 0]]
    order = np.argsort(labels, kind="stable")
    boundaries = np.flatnonzero(np.diff(labels[order])) + 1
    groups = [kept[group] for group in np.split(order, boundaries) if len(group)]
    surfaces = [_extract(mesh, group) for group in groups]
    return sorted(surfaces, key=lambda surface: -float(surface.area))


def _extract(mesh: trimesh.Trimesh, faces: Ints) -> trimesh.Trimesh:
    """Return some faces of a mesh, without colours or textures."""
    import trimesh

    used, corners = np.unique(mesh.faces[faces], return_inverse=True)
    return trimesh.Trimesh(mesh.vertices[used], corners.reshape(-1, 3), process=False)
