"""Gives a URDF meshes of its own: convex pieces where it collides, copies of what is seen."""

from __future__ import annotations

import copy
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vkc_pin.errors import InputError
from vkc_pin.importing.convex import Pieces, decompose
from vkc_pin.world.files.hulls import compute_hull
from vkc_pin.world.files.meshes import load_mesh
from vkc_pin.world.files.resources import choose_file_names
from vkc_pin.world.files.urdf import UrdfFile, UrdfShape

__all__ = ["Piece", "write_meshes"]

_WHOLE = 0.02  # [m] between a hull and its mesh that matters nowhere on a robot,
_MORE = 0.15  # nor does a hull that fills so much more than its mesh,
_SHARE = 0.15  # nor does this share of the mesh's longest edge: fingers are small
_MATERIAL = "mtllib "  # statement of an OBJ file that names its materials' file


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


def write_meshes(
    file: UrdfFile, folder: Path, *, most_pieces: int
) -> tuple[ElementTree.Element, list[Piece], list[str]]:
    """Return a URDF whose meshes are in `folder`, what became of those that collide, and notes of what was left out.

    Meshes that collide are written as convex pieces, `collision/<link>_<k>.stl`; those that are
    seen are copied into `visual`. `choose_file_names` chooses the names.

    Links without anything to collide get what is seen of them; flat meshes, and visual ones that
    cannot be read, are left out.

    Args:
        file: The URDF.
        folder: Where to write.
        most_pieces: The largest number of pieces of one mesh; 1 keeps hulls.

    Raises:
        InputError: A mesh that collides cannot be read.
    """
    root = copy.deepcopy(file.root)
    links = {link.get("name", ""): link for link in root.findall("link")}
    stems = dict(zip(links, choose_file_names(links), strict=True))
    found, notes = list[Piece](), list[str]()
    shapes: dict[str, list[UrdfShape]] = {}
    for shape in file.shapes("collision"):
        shapes.setdefault(shape.link, []).append(shape)
    done: dict[
        tuple[Path, tuple[float, ...]], tuple[Pieces, float]
    ] = {}  # with the volume of the hull
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
                    done[key] = pieces, float(compute_hull(mesh.vertices).volume)
            except InputError as error_:
                if "flat" not in error_.problem:
                    raise
                notes.append(
                    f"{name}: {shape.file.name} is flat, and collides with nothing any more"
                )
                continue
            pieces, hull = done[key]
            found.append(
                Piece(
                    name,
                    shape.file.name,
                    len(pieces.meshes),
                    pieces.overhead,
                    hull / pieces.solid - 1.0,
                    pieces.error,
                )
            )
            for mesh in pieces.meshes:
                path = folder / "collision" / f"{stems[name]}_{written}.stl"
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


def _copy_visual(
    file: UrdfFile, links: dict[str, ElementTree.Element], folder: Path, notes: list[str]
) -> None:
    shown: dict[Path, list[ElementTree.Element]] = {}
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
            shown.setdefault(path, []).append(mesh)
    for path, copy_name in _copy_meshes(list(shown), folder / "visual").items():
        for mesh in shown[path]:
            mesh.set("filename", f"visual/{copy_name}")
    if missing:
        notes.append(
            f"what is seen of {', '.join(dict.fromkeys(missing))} is left out: its mesh cannot be read"
        )


def _copy_meshes(paths: Sequence[Path], folder: Path) -> dict[Path, str]:
    """Copy meshes, OBJ files with their materials, and return the names of the copies."""
    used = {path: _find_materials(path) for path in paths if path.suffix.lower() == ".obj"}
    materials = dict.fromkeys(file for files in used.values() for file in files)
    names = _name_copies([*paths, *materials])
    for path, name in names.items():
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, folder / name)
    for path, files in used.items():
        new = {file.name: names[file] for file in files if names[file] != file.name}
        if new:
            _rename_materials(folder / names[path], new)
    return {path: names[path] for path in paths}


def _name_copies(paths: Sequence[Path]) -> dict[Path, str]:
    """Return a name in one folder for a copy of each file; extensions stay."""
    names = dict[Path, str]()
    for extension in dict.fromkeys(path.suffix.lower() for path in paths):
        same = [path for path in paths if path.suffix.lower() == extension]
        stems = choose_file_names(path.stem for path in same)
        names |= {path: f"{stem}{path.suffix}" for path, stem in zip(same, stems, strict=True)}
    return names


def _find_materials(path: Path) -> list[Path]:
    """Return the files of materials beside an OBJ file that it names."""
    named = [path.parent / name for line in _read_lines(path) if (name := _get_material(line))]
    return [file for file in named if file.is_file() and file.parent == path.parent]


def _rename_materials(path: Path, names: Mapping[str, str]) -> None:
    """Replace names of files of materials in an OBJ file."""
    lines = (
        f"{_MATERIAL}{names[name]}" if (name := _get_material(line)) in names else line
        for line in _read_lines(path)
    )
    path.write_text("\n".join(lines), encoding="utf-8", errors="surrogateescape")


def _get_material(line: str) -> str:
    """Return the file of materials that a line of an OBJ file names, or ""."""
    return line.removeprefix(_MATERIAL).strip() if line.startswith(_MATERIAL) else ""


def _read_lines(path: Path) -> list[str]:
    return path.read_text(encoding="utf-8", errors="surrogateescape").split("\n")
