"""Reads an object from a URDF file, and completes missing elements."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.importing.missing_meshes import replace_found_meshes
from vkc_pin.importing.objects.description import (
    Description,
    Joint,
    Link,
    Part,
    limit_follower,
    make_inertia,
    make_limits,
)
from vkc_pin.world.files.kinematic_tree import (
    check_tree,
    parse_inertial,
    parse_numbers,
    parse_origin,
)
from vkc_pin.world.files.urdf import UrdfFile
from vkc_pin.world.files.xml import read_xml
from vkc_pin.world.models.couplings import find_followers

_KINDS = ("fixed", "revolute", "continuous", "prismatic")


def read_object_urdf(
    file: Path,
    *,
    free: bool = False,
    packages: Mapping[str, Path] | None = None,
    text: str | None = None,
) -> Description:
    """Read the description of an object or a home from a URDF.

    Args:
        file: The file.
        free: Whether joints may be floating; otherwise floating joints count as fixed.
        packages: Folders of packages by name; others are searched for around the file.
        text: Contents, if they are not to be read from `file`.
    """
    _, root = read_xml(file, "URDF", text)
    notes = list[str]()
    stated = {
        joint.get("name", ""): _read_limits(file, joint, notes) for joint in root.findall("joint")
    }
    reached = _limit_followers(file, root, stated)
    for joint in root.findall("joint"):
        if joint.get("type") not in (*_KINDS, "floating") or (
            joint.get("type") == "floating" and not free
        ):
            notes.append(f"joint '{joint.get('name')}' is {joint.get('type')}: taken as fixed")
            joint.set("type", "fixed")
        if (mimic := joint.find("mimic")) is not None:
            name = joint.get("name", "")
            note = f"joint '{name}' mimics '{mimic.get('joint')}': made independent"
            limits = reached.get(name)
            if limits is not None and limits != stated[name]:
                note += f", from {limits[0]:g} to {limits[1]:g}, which its leader reaches"
            notes.append(note)
            joint.remove(mimic)
    stated |= reached
    # `check_tree` makes hinges with huge limits continuous.
    kinds = {joint.get("name", ""): joint.get("type", "") for joint in root.findall("joint")}
    check_tree(file, root)
    urdf = UrdfFile(file.resolve(), "", root, packages or {})
    replaced, missing = replace_found_meshes(urdf, every_link=True)
    notes += replaced
    names = _find_shape_names(root)
    parts: dict[str, dict[str, list[Part]]] = {
        kind: {link: [] for link in urdf.links} for kind in ("visual", "collision")
    }
    for kind, by_link in parts.items():
        for shape in urdf.read_shapes(kind):
            name = names.get((kind, shape.name)) or names.get(("mesh", str(shape.file))) or ""
            by_link[shape.link].append(
                Part(
                    name=name,
                    placement=shape.placement,
                    kind=shape.kind,
                    size=shape.size,
                    file=shape.file,
                    colour=shape.colour,
                )
            )
            # PartNet-Mobility names only visual shapes; collision shapes use the same files.
            if name and shape.file is not None:
                names["mesh", str(shape.file)] = name
    inertias = {
        link.get("name", ""): _read_inertia(file, link, notes) for link in root.findall("link")
    }
    links = {
        name: Link(
            name, tuple(parts["visual"][name]), tuple(parts["collision"][name]), inertias[name]
        )
        for name in urdf.links
    }
    joints = []
    for joint in root.findall("joint"):
        name = joint.get("name", "")
        joints.append(_read_joint(file, joint, kinds[name], stated[name]))
    by_child = {joint.child: joint for joint in joints}
    return Description(file, links, by_child, tuple(notes), tuple(missing))


def _find_shape_names(root: ElementTree.Element) -> dict[tuple[str, str], str]:
    """Map each shape (kind, `<link>_<k>`) to its name in the file."""
    return {
        (kind, f"{link.get('name')}_{number}"): element.get("name", "")
        for link in root.findall("link")
        for kind in ("visual", "collision")
        for number, element in enumerate(link.findall(kind))
    }


def _read_limits(
    file: Path, joint: ElementTree.Element, notes: list[str]
) -> tuple[float, float] | None:
    """Return the limits of a joint, or None if the file states none."""
    limit, name = joint.find("limit"), joint.get("name", "")
    for key in ("velocity", "effort"):  # -1 in SDF means none
        if limit is not None and limit.get(key, "").lstrip().startswith("-"):
            notes.append(f"joint '{name}' has a negative {key} limit: left out")
            del limit.attrib[key]
    if limit is None:
        joint.append(ElementTree.Element("limit", {"lower": "0", "upper": "0"}))
        return None
    if limit.get("lower") is None and limit.get("upper") is None:
        return None
    low, high = (
        parse_numbers(file, limit, key, 1, default="0", where=name, largest=math.inf)[0]
        for key in ("lower", "upper")
    )
    if low > high:
        notes.append(
            f"joint '{name}' has a lower limit above its upper limit, {low:g} and {high:g}: swapped"
        )
        low, high = high, low
        limit.set("lower", str(low))
        limit.set("upper", str(high))
    return make_limits(low, high)


def _limit_followers(
    file: Path, root: ElementTree.Element, stated: Mapping[str, tuple[float, float] | None]
) -> dict[str, tuple[float, float] | None]:
    """Return the limits of followers, within what the `stated` ones of leaders let them reach."""
    for joint in root.findall("joint"):
        mimic = joint.find("mimic")
        if mimic is not None:
            name = joint.get("name", "")
            parse_numbers(file, mimic, "multiplier", 1, default="1", where=name)
            parse_numbers(file, mimic, "offset", 1, default="0", where=name)
    return {
        name: limit_follower(
            stated[name], stated[coupling.leader], coupling.factor, coupling.offset
        )
        for name, coupling in find_followers(root).items()
        if coupling.factor
    }


def _read_inertia(file: Path, link: ElementTree.Element, notes: list[str]) -> pin.Inertia:
    """Return a link's inertia; an incomplete <inertial> counts as none, with a note."""
    name, stated = link.get("name", ""), link.find("inertial")
    if stated is None:
        return pin.Inertia.Zero()
    try:
        mass, moments, origin = parse_inertial(file, stated, name)
        return make_inertia(mass, moments, _make_placement(origin))
    except InputError as error:
        notes.append(f"link '{name}': {error}: its <inertial> counts as none")
        return pin.Inertia.Zero()


def _make_placement(origin: tuple[tuple[float, ...], tuple[float, ...]]) -> pin.SE3:
    """Return the placement of an <origin>."""
    position, angles = origin
    return pin.SE3(pin.rpy.rpyToMatrix(*angles), np.array(position))


def _parse_resistance(file: Path, dynamics: ElementTree.Element, key: str, name: str) -> float:
    """Return a resistance of a joint, which may be infinite."""
    (value,) = parse_numbers(
        file, dynamics, key, 1, default="0", where=name, largest=math.inf, is_finite=False
    )
    return value


def _read_joint(
    file: Path, element: ElementTree.Element, kind: str, limits: tuple[float, float] | None
) -> Joint:
    name = element.get("name", "")
    axis, limit = element.find("axis"), element.find("limit")
    direction = np.array([1.0, 0.0, 0.0])
    if axis is not None and kind not in ("fixed", "floating"):
        direction = np.array(parse_numbers(file, axis, "xyz", 3, default="1 0 0", where=name))
    velocity = 0.0
    if limit is not None:
        (velocity,) = parse_numbers(
            file, limit, "velocity", 1, default="0", where=name, largest=math.inf
        )
    dynamics = element.find("dynamics")
    resistance = {
        key: 0.0 if dynamics is None else _parse_resistance(file, dynamics, key, name)
        for key in ("damping", "friction")
    }
    ends = [
        (found.get("link", "") if (found := element.find(key)) is not None else "")
        for key in ("parent", "child")
    ]
    return Joint(
        name=name,
        kind=kind,
        parent=ends[0],
        child=ends[1],
        placement=_make_placement(parse_origin(file, element, name)),
        axis=direction / np.linalg.norm(direction),
        limits=None if kind == "continuous" else limits,
        velocity=velocity if velocity > 0.0 else None,
        **resistance,
    )
