"""Decomposes the links of an object into convex pieces that leave room for fingers at handles."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from vkc_pin.importing.convex import ERROR, Pieces, decompose, is_flat, measure_outside
from vkc_pin.importing.description import Description, Link, Part
from vkc_pin.importing.objects.clean_up import Surfaces
from vkc_pin.importing.progress import ImportProgress
from vkc_pin.world.files.hulls import SHEET_THICKNESS

if TYPE_CHECKING:
    import trimesh


# [m] largest protrusion of pieces of moving links, about a finger's clearance from a handle
_FINE = 0.006
_INSIDE = 1e-3  # [m] largest protrusion of a piece that counts as inside another
_TRIANGLE_SIZE = 50.0  # [bytes] of a triangle in a binary STL file; text takes up to twice as much

PieceCache = dict[tuple[Path | None, tuple[float, ...], float], Pieces]
"""Cache of the pieces of mesh files, in the mesh's frame, by file, scale and error [m]."""

PLACES_WORK = 2000.0
"""Triangles that take as long to cut as places for hands on a part are sought."""

MeshKeys = set[tuple[Path, tuple[float, ...]]]
"""Files and scales of meshes, which are cut once."""


def measure_links(links: Iterable[Link], meshes: MeshKeys) -> float:
    """Return about the number of triangles of the links' new meshes, and `PLACES_WORK`.

    Args:
        links: The links of a part.
        meshes: Meshes that count already, to which those of the links are added.
    """
    work = PLACES_WORK
    for link in links:
        for solid in link.solid:
            if solid.triangles is not None:
                work += len(solid.triangles.faces)
            elif solid.file is not None and (solid.file, solid.size) not in meshes:
                meshes.add((solid.file, solid.size))
                work += solid.file.stat().st_size / _TRIANGLE_SIZE
    return work


def decompose_links(
    description: Description,
    meshes: Surfaces,
    cache: PieceCache | None = None,
    progress: ImportProgress | None = None,
) -> Description:
    """Return the object with convex collision geometry only.

    Notes name flat shapes, pieces that protrude far, and links that collide with their visual
    shapes.

    Args:
        description: The object.
        meshes: Surfaces of its parts.
        cache: Pieces of mesh files that are known, to which new ones are added.
        progress: Progress of an import, whose next parts are the links.
    """
    notes = list(description.notes)
    links = dict[str, Link]()
    parts = description.links.values()
    for link in parts if progress is None else progress.follow(parts):
        error = _FINE if link.name in description.joints else ERROR
        solids = _decompose_link(link, meshes, error, cache, notes)
        visual = link.visual or link.collision
        collision = tuple(_remove_inner(solids))
        links[link.name] = Link(link.name, visual, collision, link.inertia)
    return dataclasses.replace(description, links=links, notes=tuple(notes))


def _decompose_link(
    link: Link, meshes: Surfaces, error: float, cache: PieceCache | None, notes: list[str]
) -> list[Part]:
    """Return the convex shapes of a link, and add notes about them."""
    solids = list[Part]()
    flat_parts = list[str]()
    for part in link.solid:
        mesh = meshes[id(part)]
        if part.kind != "mesh":
            solids.append(part)
            continue
        title = part.name or (part.file.name if part.file else "a mesh")
        if is_flat(mesh):
            flat_parts.append(title)
        pieces, protrusion = _decompose_part(part, mesh, error, cache)
        if protrusion > error:
            far = f"protrude by up to {1e3 * protrusion:.0f} mm (aim: {1e3 * error:g} mm)"
            notes.append(f"link '{link.name}': the convex pieces of {title} {far}")
        solids += [Part.from_triangles(part.name, piece, part.colour) for piece in pieces]
    if flat_parts:
        names = ", ".join(dict.fromkeys(flat_parts))
        made = f"flat shapes were made {1e3 * SHEET_THICKNESS:g} mm thick"
        notes.append(f"link '{link.name}': {made}: {names}")
    if link.visual and not link.collision:
        notes.append(f"link '{link.name}' has no collision geometry: its visual geometry is used")
    return solids


def _decompose_part(
    part: Part, mesh: trimesh.Trimesh, error: float, cache: PieceCache | None
) -> tuple[Sequence[trimesh.Trimesh], float]:
    """Return the convex pieces of a mesh in the frame of its link, and their protrusion [m]."""
    if cache is None or part.file is None:
        pieces = decompose(mesh, error=error)
        return pieces.meshes, pieces.error
    key = (part.file, part.size, error)
    if key not in cache:
        in_own_frame = dataclasses.replace(part, placement=pin.SE3.Identity())
        cache[key] = decompose(in_own_frame.make_mesh(), error=error)
    found = cache[key]
    placement = part.placement.homogeneous
    return [piece.copy().apply_transform(placement) for piece in found.meshes], found.error


def _remove_inner(parts: list[Part]) -> list[Part]:
    """Return the parts without meshes that lie inside another one."""
    meshes: dict[int, trimesh.Trimesh] = {}  # by the number of the part
    for k, part in enumerate(parts):
        if part.triangles is not None and part.kind == "mesh":
            meshes[k] = part.triangles
    # A mesh can lie in a larger one only.
    largest_first = sorted(meshes, key=lambda k: -meshes[k].volume)
    outer = list[int]()
    for k in largest_first:
        corners = np.asarray(meshes[k].vertices)
        protrusions = (measure_outside(meshes[other], corners).max() for other in outer)
        if all(protrusion >= _INSIDE for protrusion in protrusions):
            outer.append(k)
    return [part for k, part in enumerate(parts) if k not in meshes or k in outer]
