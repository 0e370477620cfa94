"""Finds coupled joints, from <mimic> in a URDF or `couplings` in a robot.yaml."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass

import pinocchio as pin

from vkc_pin.world.files.documents import Document
from vkc_pin.world.files.urdf import UrdfFile
from vkc_pin.world.files.xml import make_element_error
from vkc_pin.world.models.robot_schema import CouplingSchema

__all__ = [
    "JointCoupling",
    "apply_couplings",
    "check_followers",
    "find_coupled_groups",
    "find_followers",
    "find_joint_path",
]

_MOVING = ("revolute", "continuous", "prismatic")


@dataclass(frozen=True)
class JointCoupling:
    """Coupling of a joint to a leader: position = factor · leader position + offset.

    Attributes:
        leader: Name of the leader, which follows no other joint.
        factor: Factor; 0 only for a joint that does not move.
        offset: Offset [m] or [rad].
    """

    leader: str
    factor: float
    offset: float


def find_followers(root: ElementTree.Element) -> dict[str, JointCoupling]:
    """Return the coupling of each joint of a URDF that follows another one.

    Chains of couplings are resolved to their leader. If a leader is a descendant of one of its
    followers, the follower nearest to the root becomes the leader. Couplings to joints that do not
    exist or do not move, and circular ones, are ignored; `check_followers` reports them.
    """
    mimics, movable = _read_mimics(root), _find_movable_joints(root)
    found = {
        joint: coupling
        for joint in mimics
        if joint in movable and (coupling := _resolve_coupling(joint, mimics, movable)) is not None
    }
    for leader in dict.fromkeys(coupling.leader for coupling in found.values()):
        group = {
            joint
            for joint, coupling in found.items()
            if coupling.leader == leader and coupling.factor
        }
        ancestors = [joint for joint in _find_ancestors(root, leader) if joint in group]
        if ancestors:
            first, coupling = ancestors[0], found.pop(ancestors[0])
            found[leader] = JointCoupling(leader, 1.0, 0.0)
            for joint, other in [item for item in found.items() if item[1].leader == leader]:
                factor = other.factor / coupling.factor
                found[joint] = JointCoupling(first, factor, other.offset - factor * coupling.offset)
    return found


def check_followers(full: pin.Model, file: UrdfFile, tool_frame: str) -> None:
    """Check that the leaders of all joints on the path to the tool exist and can move."""
    mimics, movable, found = (
        _read_mimics(file.root),
        _find_movable_joints(file.root),
        find_followers(file.root),
    )
    leaders = {coupling.leader for coupling in found.values()}
    for joint in (str(full.names[j]) for j in find_joint_path(full, tool_frame)):
        if joint in mimics and joint in movable and joint not in found and joint not in leaders:
            element, expected = mimics[joint][3], "a revolute, continuous or prismatic joint"
            chain = [joint]
            while chain[-1] in mimics and chain[-1] in movable and chain[-1] not in chain[:-1]:
                chain.append(mimics[chain[-1]][0])
            if chain[-1] in chain[:-1]:
                problem, got = "couplings are circular", " → ".join(chain)
            else:
                kinds = {j.get("name"): j.get("type") for j in file.root.findall("joint")}
                kind = kinds.get(chain[-1])
                problem = "this joint on the path to the tool follows one that cannot move"
                got = (
                    f"'{chain[-1]}', which does not exist"
                    if kind is None
                    else f"'{chain[-1]}', which is {kind}"
                )
            raise make_element_error(
                file.path, element, problem, field=joint, expected=expected, got=got
            )


def find_coupled_groups(
    full: pin.Model, file: UrdfFile, tool_frame: str
) -> dict[str, dict[str, JointCoupling]]:
    """Return leader → its followers, for all groups with a joint on the path to the tool."""
    follows, path = (
        find_followers(file.root),
        {str(full.names[j]) for j in find_joint_path(full, tool_frame)},
    )
    groups: dict[str, dict[str, JointCoupling]] = {}
    for joint, coupling in follows.items():
        if coupling.factor:
            groups.setdefault(coupling.leader, {})[joint] = coupling
    return {leader: group for leader, group in groups.items() if path & {leader, *group}}


def apply_couplings(
    file: UrdfFile, couplings: Mapping[str, CouplingSchema], document: Document
) -> None:
    """Replace <mimic> elements of a URDF by the couplings of a robot.yaml.

    Args:
        file: The URDF, changed in place.
        couplings: Follower → coupling.
        document: The robot.yaml, for error messages.
    """
    movable = _find_movable_joints(file.root)
    for joint, coupling in couplings.items():
        for name in (joint, coupling.joint):
            if name not in movable:
                raise document.make_unknown_name_error(
                    ("couplings", joint), "joint that turns or slides", name, movable
                )
        for mimic in movable[joint].findall("mimic"):
            movable[joint].remove(mimic)
        multiplier, offset = repr(coupling.multiplier), repr(coupling.offset)
        ElementTree.SubElement(
            movable[joint], "mimic", joint=coupling.joint, multiplier=multiplier, offset=offset
        )
    mimics = _read_mimics(file.root)
    for joint, coupling in couplings.items():
        if _resolve_coupling(joint, mimics, movable, any_leader=True) is None:
            problem, expected = "couplings are circular", "a leader that follows no joint"
            raise document.make_error(
                ("couplings", joint), problem, expected=expected, got=coupling.joint
            )


def find_joint_path(full: pin.Model, frame: str) -> list[int]:
    """Return the indices of the joints from the world to a frame of a robot."""
    named = [other for other in full.frames if other.name == frame]
    link = next(
        (other for other in named if other.type == pin.FrameType.BODY), named[0]
    )  # prefer a link over a joint of the same name
    return list(full.supports[link.parentJoint])


def _read_mimics(
    root: ElementTree.Element,
) -> dict[str, tuple[str, float, float, ElementTree.Element]]:
    """Return joint → (leader, factor, offset, <mimic> element)."""
    found = {}
    for joint in root.findall("joint"):
        mimic = joint.find("mimic")
        if mimic is not None:
            factor, offset = float(mimic.get("multiplier", "1")), float(mimic.get("offset", "0"))
            found[joint.get("name", "")] = (mimic.get("joint", ""), factor, offset, mimic)
    return found


def _find_movable_joints(root: ElementTree.Element) -> dict[str, ElementTree.Element]:
    return {
        joint.get("name", ""): joint
        for joint in root.findall("joint")
        if joint.get("type") in _MOVING
    }


def _resolve_coupling(
    joint: str,
    mimics: Mapping[str, tuple[str, float, float, ElementTree.Element]],
    movable: Mapping[str, ElementTree.Element],
    *,
    any_leader: bool = False,
) -> JointCoupling | None:
    """Return the coupling of a joint to its leader at the end of the chain."""
    leader, factor, offset, visited = joint, 1.0, 0.0, set[str]()
    while leader in mimics and leader in movable:
        if leader in visited:
            return None
        visited.add(leader)
        next_leader, multiplier, added_offset, _ = mimics[leader]
        leader, factor, offset = next_leader, factor * multiplier, offset + factor * added_offset
    return JointCoupling(leader, factor, offset) if any_leader or leader in movable else None


def _find_ancestors(root: ElementTree.Element, joint: str) -> list[str]:
    """Return the ancestors of a joint, from the root on."""
    ends = {
        key: {
            other.get("name", ""): end.get("link", "")
            for other in root.findall("joint")
            if (end := other.find(key)) is not None
        }
        for key in ("parent", "child")
    }
    carries = {link: name for name, link in ends["child"].items()}
    found: list[str] = []
    while (parent := carries.get(ends["parent"][found[0] if found else joint])) is not None:
        found.insert(0, parent)
    return found
