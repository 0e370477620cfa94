"""Replaces missing meshes of a URDF by other files of the same stem, or by visual shapes."""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import PurePosixPath

from vkc_pin.errors import InputError
from vkc_pin.world.files.urdf import UrdfFile

__all__ = ["replace_missing_meshes"]

_EXTENSIONS = (".stl", ".obj", ".dae", ".ply", ".STL", ".OBJ", ".DAE", ".PLY")


def replace_missing_meshes(file: UrdfFile, *, every_link: bool) -> list[str]:
    """Replace missing meshes in the XML of a URDF; return a note about each.

    A file of the same stem with another extension replaces a missing one. Else the link's visual
    shapes replace a collision mesh, and a visual mesh is left out if its link does not need it for
    collision.

    Args:
        file: The URDF, which is changed in place.
        every_link: Whether every link without collision shapes collides with its visual ones, or
            only if no link has collision shapes.

    Raises:
        InputError: Meshes are missing that nothing can replace; the error lists all of them.
    """
    notes, lost, replaced = list[str](), dict[str, InputError](), set[str]()
    solid = {
        link.get("name", "")
        for link in file.root.iter("link")
        if link.find("collision") is not None
    }
    for link, kind, element, mesh, error in _find_missing_meshes(file):
        name, address = link.get("name", ""), mesh.get("filename", "")
        about = f"{name}: there is no {kind} mesh {address}"
        if (other := _find_same_stem(file, address)) is not None:
            mesh.set("filename", other)
            notes.append(f"{about}: {PurePosixPath(other).name} beside it is used")
            continue
        link.remove(element)
        if kind == "visual" and (name in solid or (solid and not every_link)):
            notes.append(f"{about}: left out")
        elif kind == "collision" and (visual := link.findall("visual")):
            if name not in replaced:
                link.extend(_make_collision(shape) for shape in visual)
                replaced.add(name)
            notes.append(f"{about}: the link's visual shapes collide instead")
        else:
            lost[address] = error
    if len(lost) == 1:
        raise next(iter(lost.values()))
    if lost:
        raise InputError(
            f"{len(lost)} meshes do not exist: {', '.join(lost)}",
            file=file.path,
            expected="mesh files, or visual shapes of the same links",
            got=next(iter(lost.values())).got,
        )
    return notes


def _find_missing_meshes(
    file: UrdfFile,
) -> Iterator[
    tuple[ElementTree.Element, str, ElementTree.Element, ElementTree.Element, InputError]
]:
    """Yield link, kind, shape, mesh and error of each missing mesh."""
    for link in file.root.findall("link"):
        for kind in ("visual", "collision"):
            for element in link.findall(kind):
                mesh = element.find("geometry/mesh")
                if mesh is not None and (error := _check_mesh(file, mesh.get("filename", ""))):
                    yield link, kind, element, mesh, error


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
    found = (f"{stem}{extension}" for extension in _EXTENSIONS if stem)
    return next((other for other in found if _check_mesh(file, other) is None), None)
