"""Writes the meshes of a URDF into its folder: convex pieces and copies of visual meshes."""

from __future__ import annotations

import copy
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vkc_pin.errors import InputError
from vkc_pin.importing.convex import Pieces, decompose, is_flat
from vkc_pin.world.files.hulls import SHEET_THICKNESS
from vkc_pin.world.files.meshes import load_mesh
from vkc_pin.world.files.resources import choose_file_names
from vkc_pin.world.files.urdf import UrdfFile, UrdfShape

# Acceptable protrusion of a hull over its mesh on a robot
_MAX_ERROR = 0.02  # [m]
_MAX_RELATIVE_ERROR = 0.15  # relative to the longest edge of the mesh, since fingers are small
_MAX_OVERHEAD = 0.15  # acceptable excess volume of a hull, relative to its mesh
_MATERIAL = "mtllib "  # statement of an OBJ file that names its material file


@dataclass(frozen=True)
class Piece:
    """Decomposition of a collision mesh.

    Attributes:
        link: Its link.
        mesh: Name of its file.
        count: Number of convex pieces.
        overhead: Volume of the pieces in excess of the mesh, relative to it.
        hull: Volume of the convex hull in excess of the mesh, relative to it.
        error: Largest protrusion of the pieces over the mesh [m].
    """

    link: str
    mesh: str
    count: int
    overhead: float
    hull: float
    error: float


def write_meshes(
    file: UrdfFile, folder: Path, *, most_pieces: int | None
) -> tuple[ElementTree.Element, list[Piece], list[str]]:
    """Write the meshes of a URDF into `folder`; return the URDF, the decompositions and notes.

    Collision meshes are written as convex pieces, `collision/<link>_<k>.stl`; visual meshes are
    copied into `visual`. `choose_file_names` chooses the names.

    Links without collision shapes collide with their visual shapes. Visual meshes that cannot be
    read are left out. Notes name them, flat meshes, and pieces that protrude far.
    """
    root = copy.deepcopy(file.root)
    links = {link.get("name", ""): link for link in root.findall("link")}
    stems = dict(zip(links, choose_file_names(links), strict=True))
    shapes = dict[str, list[UrdfShape]]()
    for shape in file.read_shapes("collision"):
        shapes.setdefault(shape.link, []).append(shape)
    notes = list[str]()
    decompositions = list[Piece]()
    done = dict[tuple[Path, tuple[float, ...]], Pieces]()  # by mesh file and scale
    for name, link in links.items():
        written = 0
        elements = link.findall("collision")
        for element, shape in zip(elements, shapes.get(name, []), strict=True):
            if shape.file is None:
                continue
            key = (shape.file, shape.size)
            if key not in done:
                done[key] = _decompose(name, shape, most_pieces, notes)
            pieces = done[key]
            decompositions.append(
                Piece(
                    link=name,
                    mesh=shape.file.name,
                    count=len(pieces.meshes),
                    overhead=pieces.overhead,
                    hull=pieces.hull_volume / pieces.solid - 1.0,
                    error=pieces.error,
                )
            )
            # The pieces stand where the mesh was.
            place = list(link).index(element)
            link.remove(element)
            for mesh in pieces.meshes:
                path = folder / "collision" / f"{stems[name]}_{written}.stl"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(mesh.export(file_type="stl"))
                piece = copy.deepcopy(element)
                for geometry in piece.iter("mesh"):
                    geometry.attrib.clear()
                    geometry.set("filename", f"collision/{path.name}")
                link.insert(place, piece)
                place += 1
                written += 1
    _copy_visual(file, links, folder, notes)
    return root, decompositions, notes


def _decompose(link: str, shape: UrdfShape, most_pieces: int | None, notes: list[str]) -> Pieces:
    """Return the convex pieces of a mesh, and note flat meshes and pieces that protrude far."""
    assert shape.file is not None
    mesh = load_mesh(shape.file, shape.size)
    error = min(_MAX_ERROR, _MAX_RELATIVE_ERROR * float(mesh.extents.max()))
    pieces = decompose(mesh, most_pieces=most_pieces, error=error, overhead=_MAX_OVERHEAD)
    title = f"{link}: {shape.file.name}"
    if is_flat(mesh):
        thickness = f"{1e3 * SHEET_THICKNESS:g} mm thick"
        notes.append(f"{title} is flat: it collides as a plate, {thickness}")
    if pieces.error > error:
        protrusion = f"{1e3 * pieces.error:.0f} mm (aim: {1e3 * error:.0f} mm)"
        notes.append(f"{title}: its pieces protrude by up to {protrusion}")
    return pieces


def copy_meshes(file: UrdfFile, folder: Path) -> ElementTree.Element:
    """Copy all meshes of a URDF into a folder; return its root element, which refers to the copies.

    Visual shapes without their meshes are left out.

    Raises:
        InputError: A mesh for collision is missing.
    """
    root = copy.deepcopy(file.root)
    users = dict[Path, list[ElementTree.Element]]()  # elements that refer to a mesh file
    for link in root.findall("link"):
        for element in (*link.findall("visual"), *link.findall("collision")):
            mesh = element.find("geometry/mesh")
            if mesh is None:
                continue
            try:
                users.setdefault(file.resolve(mesh.get("filename", "")), []).append(mesh)
            except InputError:
                if element.tag != "visual":
                    raise
                link.remove(element)
    for path, copy_name in _copy_meshes(list(users), folder / "meshes").items():
        for mesh in users[path]:
            mesh.set("filename", f"meshes/{copy_name}")
    return root


def _copy_visual(
    file: UrdfFile, links: dict[str, ElementTree.Element], folder: Path, notes: list[str]
) -> None:
    """Copy the visual meshes of a URDF, and leave out those that cannot be read, with a note."""
    users = dict[Path, list[ElementTree.Element]]()  # elements that refer to a mesh file
    missing = list[str]()
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
            users.setdefault(path, []).append(mesh)
    for path, copy_name in _copy_meshes(list(users), folder / "visual").items():
        for mesh in users[path]:
            mesh.set("filename", f"visual/{copy_name}")
    if missing:
        notes.append(f"left out unreadable visual meshes of {', '.join(dict.fromkeys(missing))}")


def _copy_meshes(paths: Sequence[Path], folder: Path) -> dict[Path, str]:
    """Copy meshes and the materials of OBJ files; return the names of the copies."""
    materials = {path: _find_materials(path) for path in paths if path.suffix.lower() == ".obj"}
    files = list(paths)
    for of_path in materials.values():
        files += of_path
    names = _name_copies(list(dict.fromkeys(files)))
    for path, name in names.items():
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, folder / name)
    for path, of_path in materials.items():
        renamed = {file.name: names[file] for file in of_path if names[file] != file.name}
        if renamed:
            _rename_materials(folder / names[path], renamed)
    return {path: names[path] for path in paths}


def _name_copies(paths: Sequence[Path]) -> dict[Path, str]:
    """Choose distinct names for copies of files in one folder; extensions stay."""
    names = dict[Path, str]()
    for extension in dict.fromkeys(path.suffix.lower() for path in paths):
        same = [path for path in paths if path.suffix.lower() == extension]
        stems = choose_file_names(path.stem for path in same)
        for path, stem in zip(same, stems, strict=True):
            names[path] = f"{stem}{path.suffix}"
    return names


def _find_materials(path: Path) -> list[Path]:
    """Return the material files beside an OBJ file that it names."""
    found = list[Path]()
    for line in _read_lines(path):
        name = _get_material(line)
        if name:
            file = path.parent / name
            if file.is_file() and file.parent == path.parent:
                found.append(file)
    return found


def _rename_materials(path: Path, names: Mapping[str, str]) -> None:
    """Replace names of material files in an OBJ file."""
    lines = list[str]()
    for line in _read_lines(path):
        name = _get_material(line)
        lines.append(f"{_MATERIAL}{names[name]}" if name in names else line)
    path.write_text("\n".join(lines), encoding="utf-8", errors="surrogateescape")


def _get_material(line: str) -> str:
    """Return the material file that a line of an OBJ file names, or ""."""
    return line.removeprefix(_MATERIAL).strip() if line.startswith(_MATERIAL) else ""


def _read_lines(path: Path) -> list[str]:
    return path.read_text(encoding="utf-8", errors="surrogateescape").split("\n")
