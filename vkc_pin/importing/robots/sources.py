"""Reads a robot's file of any kind as a URDF."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from vkc_pin.errors import InputError
from vkc_pin.importing.robots.mjcf import convert_mjcf
from vkc_pin.importing.robots.xacro_files import expand_xacro
from vkc_pin.world.files.documents import read_text
from vkc_pin.world.files.kinematic_tree import check_tree
from vkc_pin.world.files.srdf import Srdf, read_groups, read_srdf
from vkc_pin.world.files.urdf import UrdfFile
from vkc_pin.world.files.xml import parse_xml

__all__ = ["Source", "choose_free_name", "read_source"]

_KEPT = (
    "link",
    "joint",
    "material",
)  # what a URDF consists of; all else belongs to simulators and controllers


@dataclass(frozen=True, eq=False)
class Source:
    """A robot's file, read as a URDF.

    Attributes:
        file: The URDF, with the address of the file it was made from.
        kind: "URDF", "xacro" or "MJCF".
        srdf: What the SRDF beside it says.
        groups: Name of a group of the SRDF → its joints.
        notes: What could not be kept as it was.
    """

    file: UrdfFile
    kind: str
    srdf: Srdf = field(default_factory=lambda: Srdf({}, {}))
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def read_source(
    file: Path,
    scratch: Path,
    *,
    packages: Mapping[str, Path],
    arguments: Mapping[str, str],
    srdf: Path | None = None,
) -> Source:
    """Read a URDF, xacro or MJCF file; which one it is, its first element says.

    Args:
        file: The file.
        scratch: A folder for meshes of MJCF files.
        packages: Package name → folder, for `package://` and `$(find NAME)`.
        arguments: Of a xacro file.
        srdf: The SRDF; by default the one beside the file, or in `../srdf`.

    Raises:
        InputError: It is none of these, or cannot be read.
    """
    text = read_text(file, "robot")
    root = parse_xml(text, file)
    notes: list[str] = []
    states: dict[str, dict[str, float]] = {}
    if root.tag == "mujoco":
        converted = convert_mjcf(file, scratch)
        kind, notes, states, text = (
            "MJCF",
            converted.notes,
            converted.states,
            _written(converted.root),
        )
    elif root.tag != "robot":
        expected = "<robot> (URDF or xacro) or <mujoco> (MJCF)"
        raise InputError("not a robot's file", file=file, expected=expected, got=f"<{root.tag}>")
    elif "xmlns:xacro" in root.attrib or file.suffix == ".xacro":
        kind, text = "xacro", expand_xacro(file, packages, arguments)
    else:
        kind = "URDF"
    root = parse_xml(text, file)
    if left := sorted({element.tag for element in root if element.tag not in _KEPT}):
        notes.append(f"left out what a URDF does not have: {', '.join(f'<{tag}>' for tag in left)}")
        root[:] = [element for element in root if element.tag in _KEPT]
    notes += _completed(root)
    check_tree(file, root)
    read = UrdfFile(file.resolve(), _written(root), root, dict(packages))
    beside = srdf if srdf is not None else _beside(file)
    if beside is None:
        return Source(read, kind, Srdf({}, states), {}, tuple(notes))
    semantics = read_srdf(beside, links=read.links) if srdf is not None else _fitting(beside, read)
    if semantics is None:
        notes.append(
            f"{beside.name} beside it is of another robot: it names links that are not here"
        )
        return Source(read, kind, Srdf({}, states), {}, tuple(notes))
    return Source(
        read,
        kind,
        Srdf(semantics.allowed, {**states, **semantics.states}),
        _joints(beside, read),
        tuple(notes),
    )


def choose_free_name(name: str, taken: set[str]) -> str:
    """Return a name for a link that is none of those taken, nor is that of its joint, `<name>_joint`."""
    return (
        name
        if name not in taken and f"{name}_joint" not in taken
        else choose_free_name(f"{name}_", taken)
    )


def _completed(root: ElementTree.Element) -> list[str]:
    """Add what parsers of URDF insist on, and return notes of it."""
    notes, without = [], []
    for joint in root.findall("joint"):
        limit = joint.find("limit")
        if limit is not None:
            if missing := [key for key in ("effort", "velocity") if limit.get(key) is None]:
                without.append(joint.get("name", ""))
            for key in missing:
                limit.set(key, "0")
    if without:
        notes.append(
            f"{len(without)} joints name no effort or no velocity: {', '.join(without[:6])}{', ...' * (len(without) > 6)}"
        )
    return notes


def _written(root: ElementTree.Element) -> str:
    return ElementTree.tostring(root, encoding="unicode")


def _beside(file: Path) -> Path | None:
    """Return the SRDF that belongs to a file by its name."""
    name = file.name.split(".")[0]
    stems = dict.fromkeys((name, name.removesuffix("_robot")))
    places = [
        folder / f"{stem}.srdf"
        for stem in stems
        for folder in (file.parent, file.parent.parent / "srdf")
    ]
    return next((place for place in places if place.is_file()), None)


def _fitting(path: Path, file: UrdfFile) -> Srdf | None:
    try:
        return read_srdf(path, links=file.links)
    except InputError:
        return None


def _joints(path: Path, file: UrdfFile) -> dict[str, tuple[str, ...]]:
    return {name: group.joints for name, group in read_groups(path, file.root).items()}
