"""Replaces missing meshes of a URDF by other files of the same stem, or by visual shapes."""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import PurePosixPath
from typing import NamedTuple

from vkc_pin.errors import InputError
from vkc_pin.importing.description import MissingMesh
from vkc_pin.world.files.urdf import UrdfFile

_EXTENSIONS = (".stl", ".obj", ".dae", ".ply", ".STL", ".OBJ", ".DAE", ".PLY")


def replace_missing_meshes(file: UrdfFile) -> tuple[list[str], list[MissingMesh]]:
    """Replace missing meshes in the XML of a URDF, and remove those that nothing can replace.

    A file of the same stem with another extension replaces a missing one. Else the link's visual
    shapes replace a collision mesh, and a visual mesh is left out if its link has collision shapes.

    Args:
        file: The URDF, which is changed in place.

    Returns:
        A note about each mesh that was replaced or is not needed, and those that are lost.
    """
    notes = list[str]()
    lost = list[MissingMesh]()
    replaced = set[str]()  # links that collide with their visual shapes
    solid = set[str]()  # links with collision shapes
    for link in file.root.iter("link"):
        if link.find("collision") is not None:
            solid.add(link.get("name", ""))
    for link, shape, mesh, kind, error in _find_missing_meshes(file):
        name = link.get("name", "")
        address = mesh.get("filename", "")
        about = f"{name}: there is no {kind} mesh {address}"
        other = _find_same_stem(file, address)
        if other is not None:
            mesh.set("filename", other)
            notes.append(f"{about}: {PurePosixPath(other).name} beside it is used")
            continue
        link.remove(shape)
        visual = link.findall("visual")
        if kind == "visual" and name in solid:
            notes.append(f"{about}: left out")
        elif kind == "collision" and visual:
            if name not in replaced:
                link.extend(_make_collision(element) for element in visual)
                replaced.add(name)
            notes.append(f"{about}: the link's visual shapes collide instead")
        else:
            lost.append(MissingMesh(name, kind, error))
    return notes, lost


class _Missing(NamedTuple):
    """A missing mesh: its elements from the link on, the kind of shape, and the error."""

    link: ElementTree.Element
    shape: ElementTree.Element
    mesh: ElementTree.Element
    kind: str
    error: InputError


def _find_missing_meshes(file: UrdfFile) -> Iterator[_Missing]:
    for link in file.root.findall("link"):
        for kind in ("visual", "collision"):
            for element in link.findall(kind):
                mesh = element.find("geometry/mesh")
                if mesh is None:
                    continue
                error = _check_mesh(file, mesh.get("filename", ""))
                if error is not None:
                    yield _Missing(link, element, mesh, kind, error)


def _make_collision(visual: ElementTree.Element) -> ElementTree.Element:
    element = ElementTree.Element("collision")
    element.extend(copy.deepcopy(part) for part in visual if part.tag in ("origin", "geometry"))
    return element


def _check_mesh(file: UrdfFile, address: str) -> InputError | None:
    """Return the error of a mesh that does not exist."""
    try:
        file.resolve(address)
    except InputError as error:
        return error
    return None


def _find_same_stem(file: UrdfFile, address: str) -> str | None:
    """Return the address of a mesh that differs in its extension alone, or None."""
    stem, dot, _ = address.rpartition(".")
    if not dot or "/" in address[len(stem) :]:
        stem = address
    if not stem:
        return None
    for extension in _EXTENSIONS:
        other = f"{stem}{extension}"
        if _check_mesh(file, other) is None:
            return other
    return None
