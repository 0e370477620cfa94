"""Reads a robot from a URDF, xacro or MJCF file as a URDF."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from vkc_pin.errors import InputError
from vkc_pin.importing.formats import check_no_arguments, read_root
from vkc_pin.importing.missing_meshes import replace_missing_meshes
from vkc_pin.importing.parsers import expand_xacro, uses_xacro
from vkc_pin.importing.robots.mjcf import convert_mjcf
from vkc_pin.world.files.kinematic_tree import check_tree
from vkc_pin.world.files.srdf import Srdf, read_groups, read_srdf
from vkc_pin.world.files.urdf import UrdfFile
from vkc_pin.world.files.xml import parse_xml

__all__ = ["Source", "choose_free_name", "read_source"]

# Elements of a URDF; others belong to simulators and controllers.
_KEPT = ("link", "joint", "material")


@dataclass(frozen=True, eq=False)
class Source:
    """A robot's file, read as a URDF.

    Attributes:
        file: The URDF, with the path of the original file.
        kind: "URDF", "xacro" or "MJCF".
        srdf: The SRDF beside it.
        groups: Maps each group of the SRDF to its joints.
        linkages: Configurations of closed linkages, see `ConvertedRobot`.
        notes: Changes and omissions.
        warnings: Changes that can make the robot's shape wrong.
    """

    file: UrdfFile
    kind: str
    srdf: Srdf = field(default_factory=lambda: Srdf({}, {}))
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    linkages: Sequence[Sequence[Mapping[str, float]]] = ()
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def read_source(
    file: Path,
    scratch: Path,
    *,
    packages: Mapping[str, Path],
    arguments: Mapping[str, str],
    srdf: Path | None = None,
) -> Source:
    """Read a URDF, xacro or MJCF file, whose first element tells its format."""
    text, root = read_root(file, "URDF, xacro or MJCF")
    if root.tag != "robot" or not uses_xacro(root, file):
        check_no_arguments(file, arguments)
    notes: list[str] = []
    states: dict[str, dict[str, float]] = {}
    linkages: Sequence[Sequence[Mapping[str, float]]] = ()
    if root.tag == "mujoco":
        converted = convert_mjcf(file, scratch)
        kind, notes, states = "MJCF", converted.notes, converted.states
        linkages = converted.linkages
        text = _format_xml(converted.root)
    elif root.tag != "robot":
        expected = "<robot> (URDF or xacro) or <mujoco> (MJCF)"
        raise InputError(
            "the file does not describe a robot", file=file, expected=expected, got=f"<{root.tag}>"
        )
    elif uses_xacro(root, file):
        kind, text = "xacro", expand_xacro(file, packages, arguments)
    else:
        kind = "URDF"
    root = parse_xml(text, file)
    if dropped := sorted({element.tag for element in root if element.tag not in _KEPT}):
        tags = ", ".join(f"<{tag}>" for tag in dropped)
        notes.append(f"left out elements that a URDF does not have: {tags}")
        root[:] = [element for element in root if element.tag in _KEPT]
    notes += _complete_limits(root)
    check_tree(file, root)
    replaced = replace_missing_meshes(
        UrdfFile(file.resolve(), "", root, dict(packages)), every_link=False
    )
    read = UrdfFile(file.resolve(), _format_xml(root), root, dict(packages))
    warnings = tuple(replaced)
    srdf_path = srdf if srdf is not None else _find_srdf(file)
    if srdf_path is None:
        return Source(read, kind, Srdf({}, states), {}, linkages, tuple(notes), warnings)
    try:
        semantics = read_srdf(srdf_path, links=read.links)
    except InputError:
        if srdf is not None:
            raise
        notes.append(f"ignored {srdf_path.name} beside it, which names links of another robot")
        return Source(read, kind, Srdf({}, states), {}, linkages, tuple(notes), warnings)
    groups = {name: group.joints for name, group in read_groups(srdf_path, read.root).items()}
    merged = Srdf(semantics.allowed, {**states, **semantics.states})
    return Source(read, kind, merged, groups, linkages, tuple(notes), warnings)


def choose_free_name(name: str, taken: set[str]) -> str:
    """Return a name such that neither it nor `<name>_joint` is taken."""
    while taken & {name, f"{name}_joint"}:
        name += "_"
    return name


def _complete_limits(root: ElementTree.Element) -> list[str]:
    """Add the limits that URDF parsers require; return notes about them."""
    notes, incomplete = [], []
    for joint in root.findall("joint"):
        limit = joint.find("limit")
        if limit is not None:
            if missing := [key for key in ("effort", "velocity") if limit.get(key) is None]:
                incomplete.append(joint.get("name", ""))
            for key in missing:
                limit.set(key, "0")
    if incomplete:
        names = f"{', '.join(incomplete[:6])}{', ...' * (len(incomplete) > 6)}"
        notes.append(f"{len(incomplete)} joints state no effort or velocity limit: {names}")
    return notes


def _format_xml(root: ElementTree.Element) -> str:
    return ElementTree.tostring(root, encoding="unicode")


def _find_srdf(file: Path) -> Path | None:
    """Return the SRDF that belongs to a file by its name, or None."""
    name = file.name.split(".")[0]
    stems = dict.fromkeys((name, name.removesuffix("_robot")))
    places = [
        folder / f"{stem}.srdf"
        for stem in stems
        for folder in (file.parent, file.parent.parent / "srdf")
    ]
    return next((place for place in places if place.is_file()), None)
