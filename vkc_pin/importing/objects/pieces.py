"""Decomposes the links of an object into convex pieces that leave room for fingers at handles."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from vkc_pin.importing.convex import ERROR, compute_concavity, decompose
from vkc_pin.importing.objects.clean_up import Surfaces
from vkc_pin.importing.objects.description import Description, Link, Part
from vkc_pin.importing.slicing import THICKNESS, is_flat, thicken
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.hulls import compute_hull

if TYPE_CHECKING:
    import trimesh

__all__ = ["PieceCache", "decompose_links"]

# [m] Largest protrusion of pieces of moving links, about a finger's clearance from a handle
_FINE = 0.006
_INSIDE = 1e-3  # [m] largest protrusion of a piece that counts as inside another


PieceCache = dict[tuple[Path | None, tuple[float, ...], float], "Sequence[trimesh.Trimesh]"]
"""Cache of the pieces of mesh files, in the mesh's frame, by file, scale and error [m]."""


def decompose_links(
    description: Description, meshes: Surfaces, cache: PieceCache | None = None
) -> Description:
    """Return the object with convex collision geometry only.

    Notes name flat shapes, and links that collide with their visual shapes.

    Args:
        description: The object.
        meshes: Surfaces of its parts.
        cache: Cache of pieces of mesh files, to which this adds: the chairs of a home are one file.

    Raises:
        InputError: A mesh is concave, and CoACD is not installed.
    """
    notes, links = list(description.notes), dict[str, Link]()
    for name, link in description.links.items():
        error, solids, flat_parts = (
            _FINE if name in description.joints else ERROR,
            list[Part](),
            list[str](),
        )
        for part in link.solid:
            mesh = meshes[id(part)]
            if part.kind != "mesh":
                solids.append(part)
                continue
            if is_flat(mesh.vertices):
                flat_parts.append(part.name or "a mesh")
            pieces = (
                _make_convex(mesh, error)
                if cache is None or part.file is None
                else _find_cached_pieces(part, error, cache)
            )
            solids += [
                Part(
                    name=part.name,
                    placement=pin.SE3.Identity(),
                    kind="mesh",
                    size=(1.0, 1.0, 1.0),
                    triangles=piece,
                    colour=part.colour,
                )
                for piece in pieces
            ]
        outer = _remove_inner(solids)
        if flat_parts:
            names = ", ".join(dict.fromkeys(flat_parts))
            notes.append(
                f"link '{name}': flat shapes were made {1e3 * THICKNESS:g} mm thick: {names}"
            )
        if link.visual and not link.collision:
            notes.append(f"link '{name}' has no collision geometry: its visual geometry is used")
        links[name] = Link(name, link.visual or link.collision, tuple(outer), link.inertia)
    return dataclasses.replace(description, links=links, notes=tuple(notes))


def _find_cached_pieces(part: Part, error: float, cache: PieceCache) -> Sequence[trimesh.Trimesh]:
    """Return the convex pieces of a mesh file, in the frame of its link."""
    key = (part.file, part.size, error)
    if key not in cache:
        cache[key] = _make_convex(
            dataclasses.replace(part, placement=pin.SE3.Identity()).make_mesh(), error
        )
    return [piece.copy().apply_transform(part.placement.homogeneous) for piece in cache[key]]


def _make_convex(mesh: trimesh.Trimesh, error: float) -> Sequence[trimesh.Trimesh]:
    """Return convex pieces that contain a mesh."""
    if is_flat(mesh.vertices):
        return [compute_hull(thicken(np.asarray(mesh.vertices)))]
    if compute_concavity(mesh) <= error:  # cheaper than `decompose`
        return [compute_hull(mesh.vertices)]
    return decompose(mesh, error=error).meshes


def _remove_inner(parts: list[Part]) -> list[Part]:
    """Return the parts without meshes that lie inside another one."""
    planes: Mapping[int, tuple[Floats, Floats]] = {
        k: (np.asarray(part.triangles.face_normals), np.asarray(part.triangles.triangles)[:, 0])
        for k, part in enumerate(parts)
        if part.triangles is not None and part.kind == "mesh"
    }
    order = sorted(planes, key=lambda k: -parts[k].triangles.volume)  # type: ignore[union-attr]
    removed: set[int] = set()
    for number, k in enumerate(order):
        corners = np.asarray(parts[k].triangles.vertices)  # type: ignore[union-attr]
        for other in order[:number]:
            if other not in removed:
                normals, points = planes[other]
                if (corners @ normals.T - np.einsum("ij,ij->i", normals, points)).max() < _INSIDE:
                    removed.add(k)
                    break
    return [part for k, part in enumerate(parts) if k not in removed]
