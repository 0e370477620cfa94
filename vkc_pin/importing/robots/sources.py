"""Reads a robot from a URDF, xacro or MJCF file as a URDF."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from vkc_pin.errors import InputError
from vkc_pin.importing.formats import check_no_arguments, read_root
from vkc_pin.importing.missing_meshes import replace_missing_meshes
from vkc_pin.importing.parsers import expand_xacro, uses_xacro
from vkc_pin.importing.robots.mjcf import convert_mjcf
from vkc_pin.world.files.kinematic_tree import check_tree
from vkc_pin.world.files.srdf import Srdf, SrdfState, find_srdf, read_srdf
from vkc_pin.world.files.urdf import UrdfFile
from vkc_pin.world.files.xml import parse_xml

# Elements of a URDF; others belong to simulators and controllers.
_KEPT = ("link", "joint", "material")


@dataclass(frozen=True, eq=False)
class Source:
    """A robot's file, read as a URDF.

    Attributes:
        file: The URDF, with the path of the original file.
        kind: "URDF", "xacro" or "MJCF".
        srdf: The SRDF beside it, after the states of the file itself.
        linkages: Configurations of closed linkages, see `ConvertedRobot`.
        notes: Changes and omissions.
        warnings: Changes that can make the robot's shape wrong.
    """

    file: UrdfFile
    kind: str
    srdf: Srdf = field(default_factory=Srdf)
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
    own_states = tuple(SrdfState(name, "", state) for name, state in states.items())
    semantics = Srdf()
    srdf_path = srdf if srdf is not None else find_srdf(file)
    if srdf_path is not None:
        try:
            semantics = read_srdf(srdf_path, read.root)
        except InputError as error:
            if srdf is not None:
                raise
            because = error.problem if error.got is None else f"{error.problem} ({error.got})"
            notes.append(f"ignored {srdf_path.name} beside it: {because}")
        notes += [f"{srdf_path.name}: {note}" for note in semantics.notes]
    merged = replace(semantics, states=(*own_states, *semantics.states))
    return Source(read, kind, merged, linkages, tuple(notes), warnings)


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
