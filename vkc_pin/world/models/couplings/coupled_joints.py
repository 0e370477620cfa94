"""Which joints of a robot follow others, by the <mimic> of a URDF or the `couplings` of a robot.yaml, and by how much."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass

import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.world.files.documents import Document
from vkc_pin.world.files.urdf import UrdfFile
from vkc_pin.world.files.xml import line_of
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
    """How a joint follows another one: its position is factor · (the leader's) + offset, [m] or [rad].

    Attributes:
        leader: The joint that leads; it follows none.
        factor: Not 0, but for a joint that stands still.
        offset: [m] or [rad].
    """

    leader: str
    factor: float
    offset: float


def find_followers(root: ElementTree.Element) -> dict[str, JointCoupling]:
    """Return the joints of a URDF that follow another one, and how.

    A joint that follows one that follows a third follows the third. If a joint hangs on one that
    follows it, then the first of these, from the root on, leads instead. What a file says of joints
    that do not turn or slide, of such as do not exist, and of joints that follow each other in a
    circle, counts for nothing: see `check_followers`.
    """
    said, moving = _read_mimics(root), _find_movable_joints(root)
    found = {
        joint: led
        for joint in said
        if joint in moving and (led := _resolve_coupling(joint, said, moving)) is not None
    }
    for leader in dict.fromkeys(led.leader for led in found.values()):
        group = {joint for joint, led in found.items() if led.leader == leader and led.factor}
        above = [joint for joint in _find_ancestors(root, leader) if joint in group]
        if above:
            first, led = above[0], found.pop(above[0])
            found[leader] = JointCoupling(leader, 1.0, 0.0)
            for joint, other in [item for item in found.items() if item[1].leader == leader]:
                factor = other.factor / led.factor
                found[joint] = JointCoupling(first, factor, other.offset - factor * led.offset)
    return found


def check_followers(full: pin.Model, file: UrdfFile, tool_frame: str) -> None:
    """Check that what joints on the way to the tool follow can move, and is there.

    Raises:
        InputError: A joint follows one that does not exist, that does not turn or slide, or in a
            circle.
    """
    said, moving, found = (
        _read_mimics(file.root),
        _find_movable_joints(file.root),
        find_followers(file.root),
    )
    leaders = {led.leader for led in found.values()}
    for joint in (str(full.names[j]) for j in find_joint_path(full, tool_frame)):
        if joint in said and joint in moving and joint not in found and joint not in leaders:
            element, expected = said[joint][3], "a joint that turns or slides"
            chain = [joint]
            while chain[-1] in said and chain[-1] in moving and chain[-1] not in chain[:-1]:
                chain.append(said[chain[-1]][0])
            if chain[-1] in chain[:-1]:
                problem, got = "joints that follow each other in a circle", " → ".join(chain)
            else:
                kind = next(
                    (
                        other.get("type")
                        for other in file.root.findall("joint")
                        if other.get("name") == chain[-1]
                    ),
                    None,
                )
                problem = "a joint on the way to the tool follows one that cannot lead"
                got = (
                    f"'{chain[-1]}', which does not exist"
                    if kind is None
                    else f"'{chain[-1]}', which is {kind}"
                )
            raise InputError(
                problem,
                file=file.path,
                line=line_of(element),
                field=joint,
                expected=expected,
                got=got,
            )


def find_coupled_groups(
    full: pin.Model, file: UrdfFile, tool_frame: str
) -> dict[str, dict[str, JointCoupling]]:
    """Return leader → the joints that follow it, wherever they are, of joints of which one is on the way to the tool."""
    follows, path = (
        find_followers(file.root),
        {str(full.names[j]) for j in find_joint_path(full, tool_frame)},
    )
    groups: dict[str, dict[str, JointCoupling]] = {}
    for joint, led in follows.items():
        if led.factor:
            groups.setdefault(led.leader, {})[joint] = led
    return {leader: group for leader, group in groups.items() if path & {leader, *group}}


def apply_couplings(
    file: UrdfFile, couplings: Mapping[str, CouplingSchema], document: Document
) -> None:
    """Write the couplings of a robot.yaml into a URDF that was read, as <mimic>, in place of those that it has.

    Raises:
        UnknownNameError: There is no such joint.
        InputError: Joints follow each other in a circle.
    """
    moving = _find_movable_joints(file.root)
    for joint, coupling in couplings.items():
        for name in (joint, coupling.joint):
            if name not in moving:
                raise document.unknown(
                    ("couplings", joint), "joint that turns or slides", name, moving
                )
        for mimic in moving[joint].findall("mimic"):
            moving[joint].remove(mimic)
        multiplier, offset = repr(coupling.multiplier), repr(coupling.offset)
        ElementTree.SubElement(
            moving[joint], "mimic", joint=coupling.joint, multiplier=multiplier, offset=offset
        )
    said = _read_mimics(file.root)
    for joint, coupling in couplings.items():
        if _resolve_coupling(joint, said, moving, anyone=True) is None:
            problem, expected = "joints that follow each other in a circle", "one joint that leads"
            raise document.error(
                ("couplings", joint), problem, expected=expected, got=coupling.joint
            )


def find_joint_path(full: pin.Model, frame: str) -> list[int]:
    """Return the joints from the world to a frame of a robot."""
    named = [other for other in full.frames if other.name == frame]
    link = next(
        (other for other in named if other.type == pin.FrameType.BODY), named[0]
    )  # a link before a joint
    return list(full.supports[link.parentJoint])


def _read_mimics(
    root: ElementTree.Element,
) -> dict[str, tuple[str, float, float, ElementTree.Element]]:
    """Return joint → (the joint it follows, factor, offset, where it says so)."""
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
    said: Mapping[str, tuple[str, float, float, ElementTree.Element]],
    moving: Mapping[str, ElementTree.Element],
    *,
    anyone: bool = False,
) -> JointCoupling | None:
    """Return how a joint follows the one at the end of its chain, `anyone` or one that can lead; None: there is none."""
    leader, factor, offset, passed = joint, 1.0, 0.0, set[str]()
    while leader in said and leader in moving:
        if leader in passed:
            return None
        passed.add(leader)
        above, multiplier, shift, _ = said[leader]
        leader, factor, offset = above, factor * multiplier, offset + factor * shift
    return JointCoupling(leader, factor, offset) if anyone or leader in moving else None


def _find_ancestors(root: ElementTree.Element, joint: str) -> list[str]:
    """Return the joints that a joint hangs on, from the root on."""
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
    while (above := carries.get(ends["parent"][found[0] if found else joint])) is not None:
        found.insert(0, above)
    return found
