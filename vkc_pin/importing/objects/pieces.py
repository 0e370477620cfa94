"""Decomposes the links of an object into convex pieces that leave room for fingers at handles."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from vkc_pin.importing.convex import (
    ERROR,
    THICKNESS,
    compute_concavity,
    decompose,
    is_flat,
    measure_outside,
    thicken,
)
from vkc_pin.importing.objects.clean_up import Surfaces
from vkc_pin.importing.objects.description import Description, Link, Part
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
    """
    notes, links = list(description.notes), dict[str, Link]()
    for name, link in description.links.items():
        error = _FINE if name in description.joints else ERROR
        solids, flat_parts = list[Part](), list[str]()
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
        if flat_parts:
            names = ", ".join(dict.fromkeys(flat_parts))
            made = f"flat shapes were made {1e3 * THICKNESS:g} mm thick"
            notes.append(f"link '{name}': {made}: {names}")
        if link.visual and not link.collision:
            notes.append(f"link '{name}' has no collision geometry: its visual geometry is used")
        links[name] = Link(
            name, link.visual or link.collision, tuple(_remove_inner(solids)), link.inertia
        )
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
    meshes = {
        k: part.triangles
        for k, part in enumerate(parts)
        if part.triangles is not None and part.kind == "mesh"
    }
    outer = list[int]()
    for k in sorted(meshes, key=lambda k: -meshes[k].volume):
        corners = np.asarray(meshes[k].vertices)
        if all(measure_outside(meshes[other], corners).max() >= _INSIDE for other in outer):
            outer.append(k)
    return [part for k, part in enumerate(parts) if k not in meshes or k in outer]
