"""Reads SRDF files: allowed collisions, named configurations, and groups of joints."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from vkc_pin.errors import UnknownNameError
from vkc_pin.world.files.xml import read_xml

__all__ = ["Srdf", "SrdfGroup", "find_group_tip", "read_groups", "read_srdf"]


@dataclass(frozen=True)
class Srdf:
    """Contents of an SRDF.

    Attributes:
        allowed: Sorted pair of links that may collide → reason.
        states: Name → joint → position, [m] or [rad].
    """

    allowed: dict[tuple[str, str], str]
    states: dict[str, dict[str, float]]

    def state(self, joints: Collection[str]) -> dict[str, float]:
        """Return home, default, rest, or the first state that covers all `joints`; else {}."""
        fitting = {name: state for name, state in self.states.items() if set(joints) <= set(state)}
        for name in ("home", "default", "rest"):
            if name in fitting:
                return fitting[name]
        return next(iter(fitting.values()), {})


@dataclass(frozen=True)
class SrdfGroup:
    """A group of joints, with the link that the last one moves, or the tip of its chain."""

    joints: tuple[str, ...]
    tip: str


def read_groups(path: str | Path, urdf: ElementTree.Element) -> dict[str, SrdfGroup]:
    """Return the groups with joints of an SRDF, by name."""
    above, moved = dict[str, tuple[str, str]](), dict[str, str]()
    for joint in urdf.findall("joint"):
        parent, child = (
            element.get("link", "") if (element := joint.find(key)) is not None else ""
            for key in ("parent", "child")
        )
        above[child], moved[joint.get("name", "")] = (joint.get("name", ""), parent), child
    groups: dict[str, SrdfGroup] = {}
    for group in read_xml(path, "SRDF")[1].findall("group"):
        joints = [
            name for joint in group.findall("joint") if (name := joint.get("name", "")) in moved
        ]
        tip = moved[joints[-1]] if joints else ""
        for chain in group.findall("chain"):
            tip = below = chain.get("tip_link", "")
            while below in above and below != chain.get("base_link"):
                name, below = above[below]
                joints.append(name)
        if joints:
            groups[group.get("name", "")] = SrdfGroup(tuple(joints), tip)
    return groups


def find_group_tip(path: Path | None, urdf: ElementTree.Element, name: str) -> str:
    """Return the tip of a group; raise `UnknownNameError` without such a group or an SRDF."""
    groups = {} if path is None else read_groups(path, urdf)
    if name not in groups:
        raise UnknownNameError("group of an SRDF", name, groups, file=path, field="arm")
    return groups[name].tip


def read_srdf(path: str | Path, *, links: Collection[str]) -> Srdf:
    """Read an SRDF file.

    Args:
        path: The file.
        links: Links of its robot.
    """
    text, root = read_xml(path, "SRDF")
    allowed = {}
    for element in root.iter("disable_collisions"):
        pair = [element.get(key, "") for key in ("link1", "link2")]
        for name in pair:
            if name not in links:
                line = next(
                    (
                        number
                        for number, line in enumerate(text.splitlines(), 1)
                        if f'"{name}"' in line
                    ),
                    None,
                )
                raise UnknownNameError(
                    "link", name, links, file=path, line=line, field="disable_collisions"
                )
        first, second = sorted(pair)
        allowed[first, second] = element.get("reason", "")
    states: dict[str, dict[str, float]] = {}
    for element in root.iter("group_state"):
        state = states.setdefault(element.get("name", ""), {})
        for joint in element.findall("joint"):
            try:
                state[joint.get("name", "")] = float(joint.get("value", ""))
            except ValueError:
                continue  # joints of several coordinates: not ours
    return Srdf(allowed, states)
