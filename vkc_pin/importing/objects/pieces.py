"""Convex pieces of the links of an object, few enough to plan with and close enough for fingers to get around a handle."""

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

__all__ = ["Known", "decompose_links"]

# [m]: how far pieces of what moves may stand out; a finger keeps about as much from a handle
_FINE = 0.006
_INSIDE = 1e-3  # [m]: what stands out of another piece by less is part of it


Known = dict[tuple[Path | None, tuple[float, ...], float], "Sequence[trimesh.Trimesh]"]
"""Pieces of mesh files, in the frame of their mesh, by file, scale and error [m]."""


def decompose_links(
    description: Description, meshes: Surfaces, known: Known | None = None
) -> Description:
    """Return the object with convex shapes alone to collide with, what is flat or lies inside of others noted.

    Args:
        description: The object.
        meshes: Its surfaces.
        known: Pieces of files that were cut before, to which this adds: the chairs of a home are
            one file.

    Raises:
        InputError: A mesh is concave, and CoACD is not installed.
    """
    notes, links = list(description.notes), dict[str, Link]()
    for name, link in description.links.items():
        error, solids, thick = (
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
                thick.append(part.name or "a mesh")
            found = (
                _convex(mesh, error)
                if known is None or part.file is None
                else _placed(part, error, known)
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
                for piece in found
            ]
        kept = _without_inner(solids)
        if thick:
            notes.append(
                f"link '{name}': flat shapes are {1e3 * THICKNESS:g} mm thick now: {', '.join(dict.fromkeys(thick))}"
            )
        if link.visual and not link.collision:
            notes.append(
                f"link '{name}' has nothing to collide with: it collides as what it looks like"
            )
        links[name] = Link(name, link.visual or link.collision, tuple(kept), link.inertia)
    return dataclasses.replace(description, links=links, notes=tuple(notes))


def _placed(part: Part, error: float, known: Known) -> Sequence[trimesh.Trimesh]:
    """Return convex pieces of a part that is a file, in the frame of its link."""
    key = (part.file, part.size, error)
    if key not in known:
        known[key] = _convex(dataclasses.replace(part, placement=pin.SE3.Identity()).mesh(), error)
    return [piece.copy().apply_transform(part.placement.homogeneous) for piece in known[key]]


def _convex(mesh: trimesh.Trimesh, error: float) -> Sequence[trimesh.Trimesh]:
    """Return convex pieces that contain a mesh."""
    if is_flat(mesh.vertices):
        return [compute_hull(thicken(np.asarray(mesh.vertices)))]
    if compute_concavity(mesh) <= error:  # quicker to tell than all that `decompose` says
        return [compute_hull(mesh.vertices)]
    return decompose(mesh, error=error).meshes


def _without_inner(parts: list[Part]) -> list[Part]:
    """Return parts without the meshes that lie inside one of the others."""
    planes: Mapping[int, tuple[Floats, Floats]] = {
        k: (np.asarray(part.triangles.face_normals), np.asarray(part.triangles.triangles)[:, 0])
        for k, part in enumerate(parts)
        if part.triangles is not None and part.kind == "mesh"
    }
    order = sorted(planes, key=lambda k: -parts[k].triangles.volume)  # type: ignore[union-attr]
    gone: set[int] = set()
    for number, k in enumerate(order):
        corners = np.asarray(parts[k].triangles.vertices)  # type: ignore[union-attr]
        for other in order[:number]:
            if other not in gone:
                normals, points = planes[other]
                if (corners @ normals.T - np.einsum("ij,ij->i", normals, points)).max() < _INSIDE:
                    gone.add(k)
                    break
    return [part for k, part in enumerate(parts) if k not in gone]
