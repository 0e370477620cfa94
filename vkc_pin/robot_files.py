"""Finds the files of a robot and reads what its URDF says about geometry."""

from __future__ import annotations

import importlib.util
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from vkc_pin import resources
from vkc_pin.errors import InputError, UnknownNameError

if TYPE_CHECKING:
    import trimesh

__all__ = ["RobotFile", "Shape", "find_robot", "known_robots", "read_urdf"]

Colour = tuple[float, float, float, float]
_GREY: Colour = (0.6, 0.6, 0.62, 1.0)
# Names under which example-robot-data loads URDF files called otherwise.
_ALIASES = {"anymal_kinova": "anymal-kinova", "asr_twodof": "TwoDofs", "b1_z1": "b1-z1", "hyq": "hyq_no_sensors", "solo8": "solo"}


@dataclass(frozen=True)
class Shape:
    """One <visual> or <collision> element.

    Attributes:
        link: The link it belongs to.
        name: `<link>_<k>`, k counting the elements of that kind of the link.
        placement: In the link's frame.
        kind: "box", "sphere", "cylinder", "capsule" or "mesh".
        size: Edge lengths of a box, radius of a sphere, radius and length of a cylinder or capsule, [m]; scale of a mesh.
        file: The mesh file.
        colour: Red, green, blue, opacity, or None if the URDF names none.
    """

    link: str
    name: str
    placement: pin.SE3
    kind: str
    size: tuple[float, ...]
    file: Path | None = None
    colour: Colour | None = None

    def mesh(self) -> trimesh.Trimesh:
        """Return its triangles in the link's frame, [m]; round shapes as circumscribed polygons of 64 sides."""
        import trimesh

        from vkc_pin.meshes import load_mesh

        if self.file is not None:
            mesh = load_mesh(self.file, self.size)
        elif self.kind == "box":
            mesh = trimesh.creation.box(self.size)
        elif self.kind == "sphere":
            mesh = trimesh.creation.icosphere(subdivisions=3, radius=1.005 * self.size[0])
        elif self.kind == "capsule":
            mesh = trimesh.creation.capsule(height=self.size[1], radius=self.size[0] / np.cos(np.pi / 64), count=[64, 64])
        else:
            mesh = trimesh.creation.cylinder(self.size[0] / np.cos(np.pi / 64), height=self.size[1], sections=64)
        return mesh.apply_transform(self.placement.homogeneous)


@dataclass(frozen=True, eq=False)
class RobotFile:
    """A URDF file that was read.

    Attributes:
        path: The file.
        text: What it says.
        root: The same as XML.
        packages: Package name → folder, for `package://` addresses.
    """

    path: Path
    text: str
    root: ElementTree.Element
    packages: Mapping[str, Path] = field(default_factory=dict)

    @property
    def links(self) -> tuple[str, ...]:
        """The names of the links, in the file's order."""
        return tuple(link.get("name", "") for link in self.root.findall("link"))

    def shapes(self, kind: str) -> list[Shape]:
        """Return all elements of `kind`, "visual" or "collision".

        Raises:
            InputError: One of them is not understood, or its mesh file does not exist.
        """
        colours = {
            material.get("name", ""): colour for material in self.root.findall("material") if (colour := self._colour(material))
        }
        found = []
        for link in self.root.findall("link"):
            name = link.get("name", "")
            for index, element in enumerate(link.findall(kind)):
                found.append(self._shape(name, f"{name}_{index}", element, colours))
        return found

    def resolve(self, address: str) -> Path:
        """Return the file that a mesh's address means: `package://NAME/...`, `file://...`, absolute or beside the URDF.

        Raises:
            InputError: There is no such package or file.
        """
        if address.startswith("package://"):
            package, _, inside = address.removeprefix("package://").partition("/")
            folders = [self.packages[package]] if package in self.packages else []
            folders += [folder / package for folder in self.path.parents] + [self.path.parent, self.path.parent.parent]
            if package == "example-robot-data" and (data := _example_robot_data()) is not None:
                folders.append(data)  # for copies of its URDFs, wherever they are
            candidates = [folder / inside for folder in folders]
        else:
            plain = Path(address.removeprefix("file://"))
            candidates = [plain if plain.is_absolute() else self.path.parent / plain]
        for candidate in candidates:
            if candidate.is_file():
                return candidate
        tried = str(candidates[0])
        raise InputError(
            "there is no such mesh", file=self.path, field=address, expected="a mesh file", got=f"nothing at {tried}"
        )

    def _shape(self, link: str, name: str, element: ElementTree.Element, colours: Mapping[str, Colour]) -> Shape:
        geometry = element.find("geometry")
        shape = next(iter(geometry), None) if geometry is not None else None
        if shape is None:
            raise InputError("an element without geometry", file=self.path, field=name, expected="<geometry> with a shape")
        origin = element.find("origin")
        placement = pin.SE3.Identity()
        if origin is not None:
            position, angles = self._numbers(origin, "xyz", 3, "0 0 0", name), self._numbers(origin, "rpy", 3, "0 0 0", name)
            placement = pin.SE3(pin.rpy.rpyToMatrix(np.array(angles)), np.array(position))
        material = element.find("material")
        colour = None if material is None else self._colour(material) or colours.get(material.get("name", ""))
        if shape.tag == "mesh":
            file = self.resolve(shape.get("filename", ""))
            return Shape(link, name, placement, "mesh", self._numbers(shape, "scale", 3, "1 1 1", name), file, colour)
        if shape.tag == "box":
            size = self._numbers(shape, "size", 3, None, name)
        elif shape.tag == "sphere":
            size = self._numbers(shape, "radius", 1, None, name)
        elif shape.tag in ("cylinder", "capsule"):
            size = self._numbers(shape, "radius", 1, None, name) + self._numbers(shape, "length", 1, None, name)
        else:
            known = "box, sphere, cylinder, capsule or mesh"
            raise InputError("this shape is not supported", file=self.path, field=name, expected=known, got=shape.tag)
        if min(size) <= 0.0:
            raise InputError("a shape without volume", file=self.path, field=name, expected="sizes above 0", got=size)
        return Shape(link, name, placement, shape.tag, size, None, colour)

    def _colour(self, material: ElementTree.Element) -> Colour | None:
        colour = material.find("color")
        if colour is None or colour.get("rgba") is None:
            return None
        red, green, blue, opacity = self._numbers(colour, "rgba", 4, None, material.get("name", "material"))
        return (red, green, blue, opacity)

    def _numbers(self, element: ElementTree.Element, key: str, count: int, default: str | None, where: str) -> tuple[float, ...]:
        text = element.get(key, default)
        try:
            values = tuple(float(part) for part in (text or "").split())
        except ValueError:
            values = ()
        if len(values) != count or not np.isfinite(values).all():
            raise InputError(
                "wrong numbers", file=self.path, field=f"{where}: {element.tag} {key}", expected=f"{count} numbers", got=text
            )
        return values


def read_urdf(path: str | Path, packages: Mapping[str, Path] | None = None) -> RobotFile:
    """Read a URDF file.

    Args:
        path: The file.
        packages: Package name → folder. Other packages are looked for in the folders around the file.

    Raises:
        InputError: The file does not exist, is no XML, or no URDF.
    """
    file = Path(path)
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError("cannot read the URDF", file=file, expected="an existing URDF file", got=reason) from error
    try:
        root = ElementTree.fromstring(text.encode())
    except ElementTree.ParseError as error:
        raise InputError(f"not valid XML: {error}", file=file, line=error.position[0]) from error
    if root.tag != "robot":
        raise InputError("not a URDF", file=file, expected="an element <robot>", got=f"<{root.tag}>")
    return RobotFile(file.resolve(), text, root, dict(packages or {}))


def known_robots() -> dict[str, Path]:
    """Return the names `load_robot` knows and their files: those in robots/, then those of example-robot-data."""
    known = {path.parent.name: path for path in sorted(resources.folder("robots").glob("*/robot.yaml"))}
    folder = _example_robot_data()
    if folder is not None:
        files = sorted(folder.glob("robots/*/*/*.urdf"))
        stems = {file.stem: file for file in reversed(files)}
        for stem, file in stems.items():
            known.setdefault(stem, file)
            known.setdefault(stem.removesuffix("_robot"), file)
        for name, stem in _ALIASES.items():
            if stem in stems:
                known.setdefault(name, stems[stem])
    return known


def find_robot(name: str) -> Path:
    """Return the robot.yaml or URDF file of a robot.

    Args:
        name: A name of `known_robots`, or the path of a URDF file, of a robot.yaml, or of a folder that holds one.

    Raises:
        UnknownNameError: It is neither.
    """
    path = Path(name)
    if path.suffix.lower() in (".urdf", ".yaml", ".yml") or len(path.parts) != 1:
        file = path / "robot.yaml" if path.is_dir() else path
        if not file.is_file():
            raise InputError("there is no such robot", file=file, expected="a URDF file, a robot.yaml, or a robot's name")
        return file
    known = known_robots()
    if name not in known:
        raise UnknownNameError("robot", name, known)
    return known[name]


def _example_robot_data() -> Path | None:
    """Return the folder of example-robot-data (in the wheels of cmeel: cmeel.prefix/share), or None."""
    prefixes = [Path(pin.__file__).resolve().parents[4]]
    spec = importlib.util.find_spec("cmeel")
    if spec is not None and spec.origin is not None:
        prefixes.append(Path(spec.origin).resolve().parents[1] / "cmeel.prefix")
    for prefix in prefixes:
        if (prefix / "share" / "example-robot-data" / "robots").is_dir():
            return prefix / "share" / "example-robot-data"
    return None
