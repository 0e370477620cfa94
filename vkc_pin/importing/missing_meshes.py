"""Replaces missing meshes of a URDF by other files of the same stem, or by visual shapes."""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from vkc_pin.errors import InputError
from vkc_pin.world.files.urdf import UrdfFile

_EXTENSIONS = (".stl", ".obj", ".dae", ".ply", ".STL", ".OBJ", ".DAE", ".PLY")


@dataclass(frozen=True)
class MissingMesh:
    """A mesh that would collide, does not exist, and that nothing replaces.

    Attributes:
        link: Its link.
        kind: "collision", or "visual" if the link has no collision shapes.
        error: The error, whose `field` is the mesh's address.
    """

    link: str
    kind: str
    error: InputError


def replace_missing_meshes(file: UrdfFile, *, every_link: bool) -> list[str]:
    """Replace missing meshes in the XML of a URDF; return a note about each.

    See `replace_found_meshes`.

    Raises:
        InputError: Meshes are missing that nothing can replace; the error lists all of them.
    """
    notes, lost = replace_found_meshes(file, every_link=every_link)
    if lost:
        raise make_missing_error([mesh.error for mesh in lost], file.path)
    return notes


def replace_found_meshes(
    file: UrdfFile, *, every_link: bool
) -> tuple[list[str], list[MissingMesh]]:
    """Replace missing meshes in the XML of a URDF, and remove those that nothing can replace.

    A file of the same stem with another extension replaces a missing one. Else the link's visual
    shapes replace a collision mesh, and a visual mesh is left out if its link does not need it for
    collision.

    Args:
        file: The URDF, which is changed in place.
        every_link: Whether every link without collision shapes collides with its visual ones, or
            only if no link has collision shapes.

    Returns:
        A note about each mesh that was replaced or is not needed, and those that are lost.
    """
    notes, lost, replaced = list[str](), list[MissingMesh](), set[str]()
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
            lost.append(MissingMesh(name, kind, error))
    return notes, lost


def make_missing_error(errors: Sequence[InputError], file: Path) -> InputError:
    """Return one error about all missing meshes of a file.

    Args:
        errors: Errors about single meshes, whose `field` is the mesh's address.
        file: The file.
    """
    by_address = {str(error.field): error for error in errors}
    if len(by_address) == 1:
        return errors[0]
    return InputError(
        f"{len(by_address)} meshes do not exist: {', '.join(by_address)}",
        file=file,
        expected="mesh files, or visual shapes of the same links",
        got=errors[0].got,
    )


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
