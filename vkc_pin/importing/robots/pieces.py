"""Gives a URDF meshes of its own: convex pieces where it collides, copies of what is seen."""

from __future__ import annotations

import copy
import shutil
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

from vkc_pin.errors import InputError
from vkc_pin.files.meshes import load_mesh
from vkc_pin.files.urdf import UrdfFile, UrdfShape
from vkc_pin.importing.convex import Pieces, decompose

__all__ = ["Piece", "own_meshes"]

_WHOLE = 0.02  # [m] between a hull and its mesh that matters nowhere on a robot,
_MORE = 0.15  # nor does a hull that fills so much more than its mesh,
_SHARE = 0.15  # nor does this share of the mesh's longest edge: fingers are small


@dataclass(frozen=True)
class Piece:
    """What became of a mesh.

    Attributes:
        link: The link that it belongs to.
        mesh: The name of its file.
        count: Into how many convex pieces it was cut.
        overhead: How much more than it they fill.
        hull: How much more its hull alone fills.
        error: How far the pieces stand out over it [m].
    """

    link: str
    mesh: str
    count: int
    overhead: float
    hull: float
    error: float


def own_meshes(file: UrdfFile, folder: Path, *, most_pieces: int) -> tuple[ElementTree.Element, list[Piece], list[str]]:
    """Return a URDF whose meshes are in `folder`, what became of those that collide, and notes of what was left out.

    Meshes that collide are written as convex pieces, `collision/<link>_<k>.stl`; those that are seen are copied into `visual`.
    Links without anything to collide get what is seen of them; flat meshes, and visual ones that cannot be read, are left out.

    Args:
        file: The URDF.
        folder: Where to write.
        most_pieces: The largest number of pieces of one mesh; 1 keeps hulls.

    Raises:
        InputError: A mesh that collides cannot be read.
    """
    root = copy.deepcopy(file.root)
    links = {link.get("name", ""): link for link in root.findall("link")}
    found, notes = list[Piece](), list[str]()
    shapes: dict[str, list[UrdfShape]] = {}
    for shape in file.shapes("collision"):
        shapes.setdefault(shape.link, []).append(shape)
    done: dict[tuple[Path, tuple[float, ...]], tuple[Pieces, float]] = {}  # with the volume of the hull
    for name, link in links.items():
        elements = link.findall("collision")
        written = 0
        for element, shape in zip(elements, shapes.get(name, []), strict=True):
            if shape.file is None:
                continue
            place = list(link).index(element)
            link.remove(element)
            key = shape.file, shape.size
            try:
                if key not in done:
                    mesh = load_mesh(shape.file, shape.size)
                    error = min(_WHOLE, _SHARE * float(mesh.extents.max()))
                    pieces = decompose(mesh, most_pieces=most_pieces, error=error, overhead=_MORE)
                    done[key] = pieces, float(mesh.convex_hull.volume)
            except InputError as error_:
                if "flat" not in error_.problem:
                    raise
                notes.append(f"{name}: {shape.file.name} is flat, and collides with nothing any more")
                continue
            pieces, hull = done[key]
            found.append(
                Piece(name, shape.file.name, len(pieces.meshes), pieces.overhead, hull / pieces.solid - 1.0, pieces.error)
            )
            for mesh in pieces.meshes:
                path = folder / "collision" / f"{_plain(name)}_{written}.stl"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(mesh.export(file_type="stl"))
                piece = copy.deepcopy(element)
                for geometry in piece.iter("mesh"):
                    geometry.attrib.clear()
                    geometry.set("filename", f"collision/{path.name}")
                link.insert(place, piece)
                place, written = place + 1, written + 1
    _copy_visual(file, links, folder, notes)
    return root, found, notes


def _copy_visual(file: UrdfFile, links: dict[str, ElementTree.Element], folder: Path, notes: list[str]) -> None:
    copied: dict[Path, str] = {}
    missing = []
    for name, link in links.items():
        for element in link.findall("visual"):
            mesh = element.find("geometry/mesh")
            if mesh is None:
                continue
            try:
                path = file.resolve(mesh.get("filename", ""))
                load_mesh(path)
            except InputError:
                link.remove(element)
                missing.append(name)
                continue
            if path not in copied:
                copied[path] = _copied(path, folder / "visual", len(copied))
            mesh.set("filename", copied[path])
    if missing:
        notes.append(f"what is seen of {', '.join(dict.fromkeys(missing))} is left out: its mesh cannot be read")


def _copied(path: Path, folder: Path, number: int) -> str:
    """Copy a mesh, with the colours that belong to an OBJ file, and return its address in the URDF."""
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / path.name
    if target.exists():
        target = folder / f"{path.stem}_{number}{path.suffix}"
    shutil.copyfile(path, target)
    if path.suffix.lower() == ".obj":
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("mtllib "):
                material = path.parent / line.removeprefix("mtllib ").strip()
                if material.is_file() and material.parent == path.parent and not (folder / material.name).exists():
                    shutil.copyfile(material, folder / material.name)
    return f"visual/{target.name}"


def _plain(name: str) -> str:
    return "".join(letter if letter.isalnum() or letter in "_-." else "_" for letter in name)
