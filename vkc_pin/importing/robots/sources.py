"""Reads a robot from a file of any format as a URDF."""

from __future__ import annotations

import itertools
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.importing.description import (
    MOVING_KINDS,
    Coupling,
    Description,
    Joint,
    Link,
    Part,
)
from vkc_pin.importing.formats.reading import read_description
from vkc_pin.importing.robots.linkages import solve_linkages
from vkc_pin.importing.urdf_writing import make_urdf
from vkc_pin.world.files.kinematic_tree import check_tree
from vkc_pin.world.files.resources import choose_file_names
from vkc_pin.world.files.srdf import Srdf, SrdfState, find_srdf, read_srdf
from vkc_pin.world.files.urdf import UrdfFile

_FAR = 20.0  # [m] limits of prismatic joints without limits
_MOST_NAMES = 8  # in a note
_UNLIMITED = (-math.inf, math.inf)


@dataclass(frozen=True, eq=False)
class Source:
    """A robot's file, read as a URDF.

    Attributes:
        file: The URDF, with the path of the original file.
        kind: Name of its format.
        srdf: The SRDF beside it, after the states of the file itself.
        linkages: Configurations of closed linkages, see `solve_linkages`.
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
    packages: Mapping[str, str | Path] | None = None,
    arguments: Mapping[str, str] | None = None,
    srdf: Path | None = None,
) -> Source:
    """Read a robot from a file; see `read_description`.

    Args:
        file: The file.
        scratch: Folder for meshes that are not in files of their own.
        packages: Folders of packages by name; others are searched for around the file.
        arguments: Arguments of a xacro file.
        srdf: An SRDF; defaults to the one beside the file.
    """
    description = read_description(file, packages=packages, arguments=arguments)
    if description.is_world:
        description = _extract_largest_tree(description)
        description = _rename_for_frames(description)
    description = _leave_out_missing_visuals(description)
    description = _complete_limits(description)
    linkages = solve_linkages(description)
    description = _orient_couplings(description)
    description = _write_triangles(description, scratch)
    root = make_urdf(description, file.stem)
    check_tree(file, root)
    text = ElementTree.tostring(root, encoding="unicode")
    read = UrdfFile(file.resolve(), text, root)
    semantics, notes = _read_semantics(file, srdf, root)
    states = [SrdfState(name, "", state) for name, state in description.states.items()]
    return Source(
        read,
        description.format,
        replace(semantics, states=(*states, *semantics.states)),
        linkages,
        (*description.notes, *notes),
        description.warnings,
    )


def choose_free_name(name: str, taken: set[str]) -> str:
    """Return a name such that neither it nor `<name>_joint` is taken."""
    while taken & {name, f"{name}_joint"}:
        name += "_"
    return name


def _extract_largest_tree(description: Description) -> Description:
    """Return the body in the world with the most joints on it, below an empty root.

    A free body is a mobile robot, independent of its place in the file.
    """
    world = description.root
    counts = dict[str, int]()
    for body in description.children().get(world, ()):
        kinds = [description.joints[link].kind for link in description.subtree(body)]
        counts[body] = sum(kind in MOVING_KINDS for kind in kinds)
    if max(counts.values(), default=0) == 0:
        raise InputError(
            "the file has no joints", file=description.file, expected="a body with joints"
        )
    chosen = max(counts, key=lambda body: counts[body])
    others = [body for body in counts if body != chosen]
    if others:
        listed = _list_names(others)
        description = description.add_notes(f"left out other bodies in the world: {listed}")
    kept = description.subtree(chosen)
    links = {world: Link(world)}
    links |= {name: link for name, link in description.links.items() if name in kept}
    joints = {child: joint for child, joint in description.joints.items() if child in kept}
    if joints[chosen].kind == "floating":
        joints[chosen] = replace(joints[chosen], kind="fixed", placement=pin.SE3.Identity())
    names = {name: name for name in links} | {world: f"{chosen}_root"}
    extracted = description.keep(links, joints)
    return extracted.rename(names, {child: joint.name for child, joint in joints.items()})


def _rename_for_frames(description: Description) -> Description:
    """Return the robot with names that frames can have, distinct ones of links and joints."""
    taken = set[str]()
    links = {name: _choose_frame_name(name, "body", taken) for name in description.links}
    joints = {
        child: _choose_frame_name(joint.name, "joint", taken)
        for child, joint in description.joints.items()
    }
    return description.rename(links, joints)


def _choose_frame_name(name: str, kind: str, taken: set[str]) -> str:
    """Choose a name that is not in `taken`, and add it to `taken`."""
    letters = [letter if letter.isalnum() or letter in "_-" else "_" for letter in name]
    plain = "".join(letters)
    chosen = plain
    for number in itertools.count(1):
        if chosen not in taken:
            break
        chosen = f"{plain}_{kind}" if number == 1 else f"{plain}_{kind}_{number}"
    taken.add(chosen)
    return chosen


def _leave_out_missing_visuals(description: Description) -> Description:
    """Return the robot without visual meshes that do not exist, with a warning about each.

    Raises:
        InputError: Meshes are missing that would collide.
    """
    is_solid = any(link.collision for link in description.links.values())
    description, omitted = description.omit_missing_visuals(lambda mesh: is_solid)
    warnings = list(description.warnings)
    for mesh in omitted:
        warnings.append(f"{mesh.link}: there is no visual mesh {mesh.error.field}: left out")
    return replace(description, warnings=tuple(warnings))


def _complete_limits(description: Description) -> Description:
    """Return the robot with limits as a URDF has them, with notes about those that are missing."""
    joints = dict(description.joints)
    notes = list[str]()
    incomplete = list[str]()
    for child, joint in description.joints.items():
        if joint.kind not in MOVING_KINDS:
            continue
        if joint.velocity is None or joint.effort is None:
            incomplete.append(joint.name)
        if joint.kind == "continuous":
            continue
        if joint.limits is None:
            notes.append(f"joint {joint.name} states no limits: it cannot move")
            joints[child] = replace(joint, limits=(0.0, 0.0))
        elif joint.limits == _UNLIMITED:
            joints[child] = _set_free(joint)
    if incomplete:
        listed = _list_names(incomplete)
        notes.append(f"{len(incomplete)} joints state no effort or velocity limit: {listed}")
    return replace(description.add_notes(*notes), joints=joints)


def _set_free(joint: Joint) -> Joint:
    """Return a joint without end as a URDF can state it."""
    if joint.kind == "revolute":
        return replace(joint, kind="continuous", limits=None)
    return replace(joint, limits=(-_FAR, _FAR))


def _orient_couplings(description: Description) -> Description:
    """Return the robot with couplings that a URDF can state: linear, one a joint, no circles.

    A second coupling of a joint is inverted, y = a x + b to x = y / a - b / a, if that makes its
    leader follow.
    """
    notes = list[str]()
    leaders = dict[str, str]()
    oriented = list[Coupling]()
    for coupling in description.couplings:
        if coupling.leader is None:
            continue
        joint = coupling.joint
        leader = coupling.leader
        factor = coupling.factor
        offset = coupling.offset
        if not coupling.is_linear:
            about = f"joint {joint} follows {leader} by a nonlinear function"
            notes.append(f"{about}: it is linearized")
        if joint in leaders and leader not in leaders and factor:
            joint, leader = leader, joint
            offset = -offset / factor
            factor = 1.0 / factor
        first = leader
        while first in leaders:
            first = leaders[first]
        if joint in leaders or first == joint:
            about = f"joint {joint} follows {leaders.get(joint, leader)}"
            notes.append(f"{about}; another coupling of it is left out")
            continue
        leaders[joint] = leader
        oriented.append(Coupling(joint, leader, (offset, factor), coupling.element))
    return replace(description.add_notes(*notes), couplings=tuple(oriented))


def _write_triangles(description: Description, folder: Path) -> Description:
    """Write meshes that are not in files of their own as STL; return the robot with their files."""
    files = dict[int, Path]()  # by `id` of the triangles
    stems = list[str]()
    links = dict[str, Link]()

    def write(part: Part) -> Part:
        if part.triangles is None:
            return part
        key = id(part.triangles)
        if key not in files:
            (stem,) = choose_file_names([part.name or "mesh"], taken=stems)
            stems.append(stem)
            files[key] = folder / f"{stem}.stl"
            folder.mkdir(parents=True, exist_ok=True)
            files[key].write_bytes(part.triangles.export(file_type="stl"))
        return replace(part, file=files[key], triangles=None)

    for name, link in description.links.items():
        visual = tuple(write(part) for part in link.visual)
        collision = tuple(write(part) for part in link.collision)
        links[name] = replace(link, visual=visual, collision=collision)
    return replace(description, links=links)


def _read_semantics(
    file: Path, srdf: Path | None, root: ElementTree.Element
) -> tuple[Srdf, list[str]]:
    """Return a given SRDF, or the one beside the file if it fits, and notes."""
    path = srdf if srdf is not None else find_srdf(file)
    if path is None:
        return Srdf(), []
    try:
        semantics = read_srdf(path, root)
    except InputError as error:
        if srdf is not None:
            raise
        because = error.problem if error.got is None else f"{error.problem} ({error.got})"
        return Srdf(), [f"ignored {path.name} beside it: {because}"]
    return semantics, [f"{path.name}: {note}" for note in semantics.notes]


def _list_names(names: Sequence[str]) -> str:
    more = ", ..." if len(names) > _MOST_NAMES else ""
    return ", ".join(names[:_MOST_NAMES]) + more
