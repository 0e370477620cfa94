"""Writes the fixed parts of a home as obstacles of a scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.importing.homes.splitting import Home
from vkc_pin.importing.objects.clean_up import choose_name, compute_bounds, load_surfaces, move_root
from vkc_pin.importing.objects.description import Colour, Description, Link, Part
from vkc_pin.importing.objects.pieces import PieceCache, decompose_links
from vkc_pin.importing.objects.writing import write_urdf
from vkc_pin.world.files.resources import choose_file_names

__all__ = ["write_obstacles"]

# [m], and without unit: tolerance within which a visual and a collision shape coincide
_ALIKE = 1e-4


def write_obstacles(
    home: Home, source: Path, folder: Path, taken: set[str], known: PieceCache
) -> tuple[list[dict[str, Any]], list[str]]:
    """Write the fixed parts of a home, and return the scene's obstacle entries and notes.

    Each piece of furniture is one obstacle, so that reports name it; so is each shape of the
    building. Primitive shapes are written into the scene itself. Others become a URDF with convex
    pieces, whose origin is on the floor below its centre.

    Args:
        home: The home.
        source: File of the home.
        folder: Folder of the scene.
        taken: Names that obstacles cannot have; theirs are added.
        known: Cache of pieces of mesh files; new ones are added.

    Raises:
        InputError: A mesh is concave, and CoACD is not installed.
    """
    entries, notes = list[dict[str, Any]](), list[str]()
    named = {choose_name(link.name, taken): link for link in _iterate_obstacle_links(home)}
    written = [name for name, link in named.items() if not _is_simple(link)]
    stems = dict(zip(written, choose_file_names(written), strict=True))
    for name, link in named.items():
        if name not in stems:
            entries.append(_make_simple_entry(name, link))
            continue
        description = Description(source, {name: Link(name, link.visual, link.collision)}, {})
        low, high = compute_bounds(description, load_surfaces(description))
        origin = np.array([*((low + high) / 2.0)[:2], 0.0]).round(6)
        description = move_root(description, pin.SE3(np.eye(3), -origin))
        description = decompose_links(description, load_surfaces(description), known)
        notes += description.notes
        address = f"obstacles/{stems[name]}/{stems[name]}.urdf"
        write_urdf(description, folder / address)
        entries.append(
            {"name": name, "type": "urdf", "file": address, "position": _round_numbers(origin)}
        )
    return entries, notes


def _iterate_obstacle_links(home: Home) -> Iterator[Link]:
    """Yield the links that become one obstacle each."""
    for link in home.building:
        for number, part in enumerate(link.solid):
            colour = _find_colour(part, link.visual)
            coloured = part if colour is None else _set_colour(part, colour)
            yield Link(
                part.name or (link.name if len(link.solid) == 1 else f"{link.name}_{number}"),
                (coloured,),
                (coloured,),
            )
    yield from home.furniture


def _is_simple(link: Link) -> bool:
    """Return whether a link's collision geometry is one primitive shape."""
    return len(link.solid) == 1 and link.solid[0].kind != "mesh"


def _make_simple_entry(name: str, link: Link) -> dict[str, Any]:
    """Return the scene entry of a link that is a box, sphere, cylinder or capsule."""
    (part,) = link.solid
    keys = {
        "box": ("size",),
        "sphere": ("radius",),
        "cylinder": ("radius", "length"),
        "capsule": ("radius", "length"),
    }[part.kind]
    size = [round(float(value), 6) for value in part.size]
    entry: dict[str, Any] = {"name": name, "type": part.kind}
    entry |= {"size": size} if part.kind == "box" else dict(zip(keys, size, strict=True))
    entry["position"] = _round_numbers(part.placement.translation)
    if not np.allclose(part.placement.rotation, np.eye(3), atol=1e-9):
        entry["rpy"] = _round_numbers(pin.rpy.matrixToRpy(part.placement.rotation), 9)
    colour = _find_colour(part, link.visual)
    return (
        entry
        if colour is None
        else {**entry, "colour": [round(float(value), 4) for value in colour]}
    )


def _find_colour(part: Part, visual: Iterable[Part]) -> Colour | None:
    """Return the colour of a shape, or of the visual shape at the same placement."""
    if part.colour is not None:
        return part.colour
    placement = part.placement.homogeneous
    return next(
        (
            other.colour
            for other in visual
            if np.allclose(other.placement.homogeneous, placement, atol=_ALIKE)
        ),
        None,
    )


def _set_colour(part: Part, colour: Colour) -> Part:
    return dataclasses.replace(part, colour=colour)


def _round_numbers(values: Any, digits: int = 6) -> list[float]:
    return [float(value) + 0.0 for value in np.round(np.asarray(values, float), digits) + 0.0]
