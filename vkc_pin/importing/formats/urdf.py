"""Reads a URDF file (http://wiki.ros.org/urdf/XML)."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.importing.description import (
    MOVING_KINDS,
    Coupling,
    Description,
    Joint,
    Limits,
    Link,
    Part,
    make_inertia,
    make_limits,
)
from vkc_pin.importing.formats.missing_meshes import replace_missing_meshes
from vkc_pin.world.files.kinematic_tree import (
    check_tree,
    parse_inertial,
    parse_numbers,
    parse_origin,
)
from vkc_pin.world.files.urdf import UrdfFile
from vkc_pin.world.files.xml import read_xml

_READ = ("link", "joint", "material")
"""Elements of a URDF; others belong to simulators and controllers."""


def read_urdf_description(
    file: Path, packages: Mapping[str, Path], *, text: str | None = None
) -> Description:
    """Read the description of a robot, an object or a home from a URDF.

    Args:
        file: The file.
        packages: Folders of packages by name; others are searched for around the file.
        text: Contents, if they are not to be read from `file`.
    """
    _, root = read_xml(file, "URDF", text)
    return _Reader(file, root, packages).read()


class _Reader:
    def __init__(self, file: Path, root: ElementTree.Element, packages: Mapping[str, Path]) -> None:
        self._file = file
        self._root = root
        self._urdf = UrdfFile(file.resolve(), "", root, packages)
        self._notes = list[str]()

    def read(self) -> Description:
        """Return the description."""
        self._remove_foreign_elements()
        elements = self._root.findall("joint")
        # `check_tree` makes hinges with huge limits continuous, and wants limits.
        kinds = {joint.get("name", ""): joint.get("type", "") for joint in elements}
        limits = {joint.get("name", ""): self._read_limits(joint) for joint in elements}
        check_tree(self._file, self._root)
        warnings, missing = replace_missing_meshes(self._urdf)
        names = self._find_shape_names()
        visual = self._read_shapes("visual", names)
        collision = self._read_shapes("collision", names)
        links = dict[str, Link]()
        for element in self._root.findall("link"):
            name = element.get("name", "")
            inertia = self._read_inertia(element)
            links[name] = Link(name, tuple(visual[name]), tuple(collision[name]), inertia)
        joints = dict[str, Joint]()
        couplings = list[Coupling]()
        for element in elements:
            name = element.get("name", "")
            joint = self._read_joint(element, kinds[name], limits[name])
            joints[joint.child] = joint
            couplings += self._read_mimic(element)
        return Description(
            self._file,
            links,
            joints,
            notes=tuple(self._notes),
            missing=tuple(missing),
            format="URDF",
            couplings=tuple(couplings),
            warnings=tuple(warnings),
        )

    def _remove_foreign_elements(self) -> None:
        """Remove the elements that a URDF does not have, with a note."""
        foreign = sorted({element.tag for element in self._root if element.tag not in _READ})
        if foreign:
            tags = ", ".join(f"<{tag}>" for tag in foreign)
            self._notes.append(f"left out elements that a URDF does not have: {tags}")
        self._root[:] = [element for element in self._root if element.tag in _READ]

    def _read_limits(self, joint: ElementTree.Element) -> Limits | None:
        """Return the limits of a joint, and mend its <limit> so that `check_tree` accepts it."""
        name = joint.get("name", "")
        limit = joint.find("limit")
        if limit is None:
            joint.append(ElementTree.Element("limit", {"lower": "0", "upper": "0"}))
            return None
        for key in ("velocity", "effort"):  # -1 in SDF means none
            if limit.get(key, "").lstrip().startswith("-"):
                self._notes.append(f"joint '{name}' has a negative {key} limit: left out")
                del limit.attrib[key]
        if limit.get("lower") is None and limit.get("upper") is None:
            return None
        low = self._parse_rate(limit, "lower", name)
        high = self._parse_rate(limit, "upper", name)
        if low > high:
            ends = f"{low:g} and {high:g}"
            self._notes.append(
                f"joint '{name}' has a lower limit above its upper limit, {ends}: swapped"
            )
            low, high = high, low
            limit.set("lower", str(low))
            limit.set("upper", str(high))
        return make_limits(low, high)

    def _parse_rate(self, limit: ElementTree.Element, key: str, name: str) -> float:
        """Return a number of a <limit>, 0 if it is not stated."""
        (value,) = parse_numbers(
            self._file, limit, key, 1, default="0", where=name, largest=math.inf
        )
        return value

    def _find_shape_names(self) -> dict[tuple[str, str], str]:
        """Map each shape (kind, `<link>_<k>`) to its name in the file."""
        names = dict[tuple[str, str], str]()
        for link in self._root.findall("link"):
            for kind in ("visual", "collision"):
                for number, element in enumerate(link.findall(kind)):
                    names[kind, f"{link.get('name')}_{number}"] = element.get("name", "")
        return names

    def _read_shapes(self, kind: str, names: dict[tuple[str, str], str]) -> dict[str, list[Part]]:
        """Return the shapes of each link.

        A collision mesh without a name is called like the visual shape of the same file:
        PartNet-Mobility names visual shapes only.
        """
        parts: dict[str, list[Part]] = {link: [] for link in self._urdf.links}
        for shape in self._urdf.read_shapes(kind):
            of_file = ("mesh", str(shape.file))
            name = names.get((kind, shape.name)) or names.get(of_file) or ""
            if name and shape.file is not None:
                names[of_file] = name
            part = Part(
                name=name,
                placement=shape.placement,
                kind=shape.kind,
                size=shape.size,
                file=shape.file,
                colour=shape.colour,
            )
            parts[shape.link].append(part)
        return parts

    def _read_inertia(self, link: ElementTree.Element) -> pin.Inertia:
        """Return a link's inertia; an incomplete <inertial> counts as none, with a note."""
        name = link.get("name", "")
        stated = link.find("inertial")
        if stated is None:
            return pin.Inertia.Zero()
        try:
            mass, moments, origin = parse_inertial(self._file, stated, name)
            return make_inertia(mass, moments, _make_placement(origin))
        except InputError as error:
            self._notes.append(f"link '{name}': {error}: its <inertial> counts as none")
            return pin.Inertia.Zero()

    def _read_joint(self, element: ElementTree.Element, kind: str, limits: Limits | None) -> Joint:
        name = element.get("name", "")
        direction = np.array([1.0, 0.0, 0.0])
        axis = element.find("axis")
        if axis is not None and kind in MOVING_KINDS:
            stated = parse_numbers(self._file, axis, "xyz", 3, default="1 0 0", where=name)
            direction = np.array(stated)
        velocity = 0.0
        effort = 0.0
        limit = element.find("limit")
        if limit is not None:
            velocity = self._parse_rate(limit, "velocity", name)
            effort = self._parse_rate(limit, "effort", name)
        return Joint(
            name=name,
            kind=kind,
            parent=_find_end(element, "parent"),
            child=_find_end(element, "child"),
            placement=_make_placement(parse_origin(self._file, element, name)),
            axis=direction / np.linalg.norm(direction),
            limits=None if kind == "continuous" else limits,
            velocity=velocity if velocity > 0.0 else None,
            effort=effort if effort > 0.0 else None,
            damping=self._read_resistance(element, "damping"),
            friction=self._read_resistance(element, "friction"),
        )

    def _read_resistance(self, joint: ElementTree.Element, key: str) -> float:
        """Return a resistance of a joint, which may be infinite."""
        dynamics = joint.find("dynamics")
        if dynamics is None:
            return 0.0
        (value,) = parse_numbers(
            self._file,
            dynamics,
            key,
            1,
            default="0",
            where=joint.get("name", ""),
            largest=math.inf,
            is_finite=False,
        )
        return value

    def _read_mimic(self, joint: ElementTree.Element) -> list[Coupling]:
        """Return the coupling of a joint to another one, which may not exist."""
        mimic = joint.find("mimic")
        if mimic is None:
            return []
        name = joint.get("name", "")
        (factor,) = parse_numbers(self._file, mimic, "multiplier", 1, default="1", where=name)
        (offset,) = parse_numbers(self._file, mimic, "offset", 1, default="0", where=name)
        return [Coupling(name, mimic.get("joint", ""), (offset, factor), "<mimic>")]


def _find_end(joint: ElementTree.Element, key: str) -> str:
    """Return the link that a joint names as its "parent" or "child"."""
    element = joint.find(key)
    return "" if element is None else element.get("link", "")


def _make_placement(origin: tuple[tuple[float, ...], tuple[float, ...]]) -> pin.SE3:
    """Return the placement of an <origin>."""
    position, angles = origin
    return pin.SE3(pin.rpy.rpyToMatrix(*angles), np.array(position))
