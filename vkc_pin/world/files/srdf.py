"""Reads SRDF files: allowed collisions, named configurations, and groups of joints.

The elements have the meaning that MoveIt gives them (`src/model.cpp` of
github.com/moveit/srdfdom): those that name unknown links, joints or groups are skipped, one by
one, and noted.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from vkc_pin.errors import InputError
from vkc_pin.world.files.xml import find_line, read_xml, replace_forbidden

Pair = tuple[str, str]
_HOMES = ("home", "default", "rest")  # names of states of rest, the preferred one first
_LISTED = 6  # names in a note
_LINK_ATTRIBUTES = ("link", "link1", "link2", "base_link", "tip_link")


@dataclass(frozen=True)
class SrdfGroup:
    """A group of joints, and the link that is furthest from the root among those they move."""

    joints: tuple[str, ...]
    tip: str


@dataclass(frozen=True)
class SrdfState:
    """A named configuration of a group: joint → position, [m] or [rad]."""

    name: str
    group: str
    positions: Mapping[str, float]


@dataclass(frozen=True)
class SrdfPlanarJoint:
    """A virtual joint on which the robot drives.

    Attributes:
        name: Its name.
        motion_model: "holonomic" or "diff_drive"; None if the file states none.
    """

    name: str
    motion_model: str | None = None


@dataclass(frozen=True)
class AllowedPairs:
    """Allowed collisions of an SRDF.

    Attributes:
        allowed: Sorted pair of links that may collide → reason.
        unknown: Names in the file that are no links → their line.
    """

    allowed: dict[Pair, str]
    unknown: dict[str, int | None]


@dataclass(frozen=True)
class Srdf:
    """Contents of an SRDF.

    Attributes:
        allowed: Sorted pair of links that may collide → reason.
        states: Named configurations, in the order of the file.
        groups: Groups with joints, by name.
        planar_joint: The first `virtual_joint` of type "planar", if there is one.
        notes: Skipped elements.
    """

    allowed: dict[Pair, str] = field(default_factory=dict)
    states: tuple[SrdfState, ...] = ()
    groups: dict[str, SrdfGroup] = field(default_factory=dict)
    planar_joint: SrdfPlanarJoint | None = None
    notes: tuple[str, ...] = ()

    def find_states(
        self, joints: Collection[str], group: str | None = None
    ) -> dict[str, dict[str, float]]:
        """Return the configurations of some joints that the file states, by name.

        A state belongs to its group, and groups may have states of the same name. That of `group`
        counts first, even if it states only some of the joints; then one that states all of them,
        the shortest first; then all of a name together, unless two contradict each other.

        Args:
            joints: The joints.
            group: The group that is planned, if one was chosen.
        """
        found: dict[str, dict[str, float]] = {}
        for name in dict.fromkeys(state.name for state in self.states):
            states = [state for state in self.states if state.name == name]
            states.sort(key=lambda state: (state.group != group, len(state.positions)))
            chosen = _choose_positions(states, joints, group)
            if chosen:
                found[name] = chosen
        return found

    def find_home(self, joints: Collection[str], group: str | None = None) -> dict[str, float]:
        """Return the state home, default or rest of some joints, else the first; else {}.

        States of the group that is planned come first; see `find_states`.
        """
        states = self.find_states(joints, group)
        own_names = {state.name for state in self.states if state.group == group}
        names = [name for name in states if name in own_names] or list(states)
        for home in (*_HOMES, *names):
            if home in names:
                return states[home]
        return {}


def _choose_positions(
    states: Sequence[SrdfState], joints: Collection[str], group: str | None
) -> dict[str, float]:
    """Return the positions of joints in states of one name, or {}; the first states count most."""
    parts = [_select_positions(state, joints) for state in states]
    is_own = bool(states) and group is not None and states[0].group == group
    if not is_own:
        for part in parts:
            if part.keys() >= set(joints):
                return part
    merged: dict[str, float] = {}
    for part in parts:
        agrees = all(merged.get(joint, value) == value for joint, value in part.items())
        if agrees:
            merged.update(part)
        elif not is_own:
            return {}
    return merged if is_own or merged.keys() >= set(joints) else {}


def _select_positions(state: SrdfState, joints: Collection[str]) -> dict[str, float]:
    return {joint: state.positions[joint] for joint in joints if joint in state.positions}


def find_srdf(file: Path) -> Path | None:
    """Return the SRDF of a robot's or home's file by its name, beside it or in ../srdf, or None."""
    name, _, _ = file.name.partition(".")
    for stem in (file.stem, name, name.removesuffix("_robot")):
        for folder in (file.parent, file.parent.parent / "srdf"):
            candidate = folder / f"{stem}.srdf"
            if candidate.is_file():
                return candidate
    return None


def format_srdf(
    name: str,
    home: Mapping[str, float],
    allowed: Mapping[tuple[str, str], str],
    comment: str = "",
) -> str:
    """Return an SRDF with a group `arm` and its state `home`.

    Args:
        name: Name of the robot.
        home: Joint → position in the state, [m] or [rad].
        allowed: Pair of links that may collide → reason.
        comment: Text of a comment.
    """
    root = ElementTree.Element("robot", name=replace_forbidden(name))
    group = ElementTree.SubElement(root, "group", name="arm")
    state = ElementTree.SubElement(root, "group_state", name="home", group="arm")
    for joint, position in home.items():
        ElementTree.SubElement(group, "joint", name=joint)
        ElementTree.SubElement(state, "joint", name=joint, value=f"{position:.12g}")
    for (one, other), reason in allowed.items():
        pair = {"link1": one, "link2": other, "reason": reason}
        ElementTree.SubElement(root, "disable_collisions", pair)
    ElementTree.indent(root)
    head = ['<?xml version="1.0"?>']
    if comment:
        head.append(f"<!-- {comment} -->")
    return "\n".join([*head, ElementTree.tostring(root, encoding="unicode")]) + "\n"


def read_srdf(path: str | Path, urdf: ElementTree.Element) -> Srdf:
    """Read an SRDF file.

    Args:
        path: The file.
        urdf: Root element of its robot's URDF.

    Raises:
        InputError: The file is no SRDF, or names links, but none of this robot.
    """
    _, root = read_xml(path, "SRDF")
    tree = _Tree(urdf)
    references = _find_link_references(root)
    if references and not references & tree.links:
        raise InputError(
            "the SRDF names no link of this robot",
            file=path,
            expected=f"links such as {format_names(list(tree.links)[:2])}",
            got=format_names(sorted(references)),
        )
    pairs = _read_pairs(root, [tree.links])
    virtual_joints = {element.get("name", "").strip() for element in root.findall("virtual_joint")}
    groups = _GroupReader(root, tree)
    states, unknown_in_states = _read_states(root, tree)
    unknown_links = dict.fromkeys((*pairs.unknown, *groups.unknown_links))
    unknown_joints = {*groups.unknown_joints, *unknown_in_states} - virtual_joints
    notes = list[str]()
    for kind, names in (("links", list(unknown_links)), ("joints", sorted(unknown_joints))):
        if names:
            notes.append(f"skipped {kind} that the robot does not have: {format_names(names)}")
    placing = sorted(virtual_joints.intersection(unknown_in_states))
    if placing:
        # A scene states where the robot starts.
        notes.append(f"skipped places of the base in states: {format_names(placing)}")
    if groups.invalid:
        notes.append(f"skipped groups of groups that are missing: {format_names(groups.invalid)}")
    planar_joint = _read_planar_joint(root)
    return Srdf(pairs.allowed, states, groups.groups, planar_joint, tuple(notes))


def _read_planar_joint(root: ElementTree.Element) -> SrdfPlanarJoint | None:
    """Return the first planar virtual joint, with the motion model of its `joint_property`."""
    for element in root.findall("virtual_joint"):
        if element.get("type", "").strip() != "planar":
            continue
        name = element.get("name", "").strip()
        for item in root.findall("joint_property"):
            is_own = item.get("joint_name", "").strip() == name
            if is_own and item.get("property_name", "").strip() == "motion_model":
                return SrdfPlanarJoint(name, item.get("value", "").strip())
        return SrdfPlanarJoint(name)
    return None


def _find_link_references(root: ElementTree.Element) -> set[str]:
    """Return all names of links in an SRDF."""
    names = set[str]()
    for element in root.iter():
        names.update(element.get(key, "") for key in _LINK_ATTRIBUTES)
    for element in root.iter("link"):
        names.add(element.get("name", ""))
    return {name.strip() for name in names} - {""}


def read_allowed_pairs(path: str | Path, models: Sequence[Collection[str]]) -> AllowedPairs:
    """Read only the allowed collisions of an SRDF file.

    Args:
        path: The file.
        models: Names of the links of each model. `<disable_default_collisions>` of a link concerns
            its pairs with links of the same model.
    """
    _, root = read_xml(path, "SRDF")
    return _read_pairs(root, models)


def _read_pairs(root: ElementTree.Element, models: Sequence[Collection[str]]) -> AllowedPairs:
    """Return the allowed pairs; the most specific element counts, and allowing before checking.

    As in MoveIt, `<disable_default_collisions>` allows all pairs of a link, `<enable_collisions>`
    checks some of these nevertheless, and `<disable_collisions>` allows a pair in any case.
    """
    known = set[str]().union(*models)
    unknown: dict[str, int | None] = {}
    allowed: dict[Pair, str] = {}
    for element in root.findall("disable_default_collisions"):
        link = element.get("link", "").strip()
        if link not in known:
            unknown.setdefault(link, find_line(element))
        for model in models:
            if link in model:
                pairs = [_sort_pair(link, other) for other in model if other != link]
                allowed.update(dict.fromkeys(pairs, "Default"))
    for tag in ("enable_collisions", "disable_collisions"):
        for element in root.findall(tag):
            one = element.get("link1", "").strip()
            other = element.get("link2", "").strip()
            missing = [name for name in (one, other) if name not in known]
            for name in missing:
                unknown.setdefault(name, find_line(element))
            if missing:
                continue
            pair = _sort_pair(one, other)
            if tag == "enable_collisions":
                allowed.pop(pair, None)
            else:
                allowed[pair] = element.get("reason", "")
    return AllowedPairs(allowed, unknown)


class _Tree:
    """Links and joints of a URDF."""

    def __init__(self, urdf: ElementTree.Element) -> None:
        names = [link.get("name", "") for link in urdf.findall("link")]
        self.links = dict.fromkeys(names).keys()
        self.child_links = dict[str, str]()  # joint → its child link
        self.parent_joints = dict[str, str]()  # link → the joint that carries it
        self.parent_links = dict[str, str]()  # link → the link that carries it
        for joint in urdf.findall("joint"):
            name = joint.get("name", "")
            parent = joint.find("parent")
            child = joint.find("child")
            parent_link = "" if parent is None else parent.get("link", "")
            child_link = "" if child is None else child.get("link", "")
            self.child_links[name] = child_link
            self.parent_joints[child_link] = name
            self.parent_links[child_link] = parent_link

    def list_ancestors(self, link: str) -> list[str]:
        """Return a link and those above it, up to the root."""
        found = [link]
        # The number of links ends circles.
        while found[-1] in self.parent_links and len(found) <= len(self.links):
            found.append(self.parent_links[found[-1]])
        return found

    def find_chain(self, base: str, tip: str) -> list[str]:
        """Return the joints between two links, by their nearest common ancestor."""
        from_base = self.list_ancestors(base)
        from_tip = self.list_ancestors(tip)
        links = [link for link in from_base if link not in from_tip]
        links += [link for link in reversed(from_tip) if link not in from_base]
        return [self.parent_joints[link] for link in links if link in self.parent_joints]


class _GroupReader:
    """Reads groups, which consist of links, joints, chains and other groups.

    A link stands for its parent joint. Groups of groups that are missing are invalid.

    Attributes:
        groups: Groups with joints, by name.
        unknown_links, unknown_joints: Names that are skipped.
        invalid: Names of groups that are skipped.
    """

    def __init__(self, root: ElementTree.Element, tree: _Tree) -> None:
        self._tree = tree
        self.unknown_links = dict[str, None]()
        self.unknown_joints = dict[str, None]()
        waiting = {element.get("name", "").strip(): element for element in root.findall("group")}
        moved_by_group = dict[str, dict[str, str]]()  # group → its joints → their child links
        while True:
            ready = list[str]()
            for name, element in waiting.items():
                parts = _read_names(element, "group")
                if moved_by_group.keys() >= set(parts):
                    ready.append(name)
            if not ready:
                break
            for name in ready:
                element = waiting.pop(name)
                moved = self._find_moved_links(element)
                for part in _read_names(element, "group"):
                    moved.update(moved_by_group[part])
                moved_by_group[name] = moved
        self.invalid = list(waiting)
        self.groups = dict[str, SrdfGroup]()
        for name, moved in moved_by_group.items():
            if moved:
                self.groups[name] = SrdfGroup(tuple(moved), self._find_tip(moved))

    def _find_moved_links(self, group: ElementTree.Element) -> dict[str, str]:
        """Return the joints of a group with the links that they move, without other groups."""
        tree = self._tree
        moved: dict[str, str] = {}
        for link in _read_names(group, "link"):
            if link not in tree.links:
                self.unknown_links[link] = None
            elif link in tree.parent_joints:  # the root has none
                moved[tree.parent_joints[link]] = link
        for joint in _read_names(group, "joint"):
            if joint in tree.child_links:
                moved[joint] = tree.child_links[joint]
            else:
                self.unknown_joints[joint] = None
        for chain in group.findall("chain"):
            base = chain.get("base_link", "").strip()
            tip = chain.get("tip_link", "").strip()
            missing = [link for link in (base, tip) if link not in tree.links]
            self.unknown_links.update(dict.fromkeys(missing))
            if not missing:
                for joint in tree.find_chain(base, tip):
                    moved[joint] = tree.child_links[joint]
        return moved

    def _find_tip(self, moved: Mapping[str, str]) -> str:
        """Return the link furthest from the root, the last of several."""
        links = list(moved.values())
        return max(reversed(links), key=lambda link: len(self._tree.list_ancestors(link)))


def _read_names(element: ElementTree.Element, tag: str) -> list[str]:
    return [child.get("name", "").strip() for child in element.findall(tag)]


def _read_states(
    root: ElementTree.Element, tree: _Tree
) -> tuple[tuple[SrdfState, ...], dict[str, None]]:
    """Return the states of groups, and names in them that are no joints."""
    states = list[SrdfState]()
    unknown = dict[str, None]()
    for element in root.findall("group_state"):
        positions: dict[str, float] = {}
        for joint in element.findall("joint"):
            joint_name = joint.get("name", "").strip()
            if joint_name not in tree.child_links:
                unknown[joint_name] = None
                continue
            # Joints of several coordinates have several numbers, and are not planned.
            try:
                position = float(joint.get("value", ""))
            except ValueError:
                continue
            if math.isfinite(position):
                positions[joint_name] = position
        name = element.get("name", "").strip()
        group = element.get("group", "").strip()
        states.append(SrdfState(name, group, positions))
    return tuple(states), unknown


def _sort_pair(one: str, other: str) -> Pair:
    return (one, other) if one <= other else (other, one)


def format_names(names: Collection[str]) -> str:
    """Return names as text; "" is an attribute that is missing."""
    listed = ", ".join(name or '""' for name in list(names)[:_LISTED])
    if len(names) > _LISTED:
        listed += f", ... ({len(names)})"
    return listed
