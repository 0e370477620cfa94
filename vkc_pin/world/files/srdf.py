"""Reads SRDF files: allowed collisions, named configurations, and groups of joints.

The elements mean what they mean to MoveIt (`src/model.cpp` of github.com/moveit/srdfdom): elements
that name unknown links, joints or groups are skipped, one by one, and noted.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from vkc_pin.errors import InputError
from vkc_pin.world.files.xml import find_line, read_xml

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
        notes: What was skipped.
    """

    allowed: dict[Pair, str] = field(default_factory=dict)
    states: tuple[SrdfState, ...] = ()
    groups: dict[str, SrdfGroup] = field(default_factory=dict)
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
        own = {state.name for state in self.states if state.group == group} & states.keys()
        names = [name for name in states if not own or name in own]
        for home in (*_HOMES, *names):
            if home in names:
                return states[home]
        return {}


def _choose_positions(
    states: Sequence[SrdfState], joints: Collection[str], group: str | None
) -> dict[str, float]:
    """Return the positions of joints in states of one name, or {}; the first states count most."""
    parts = [
        {joint: state.positions[joint] for joint in joints if joint in state.positions}
        for state in states
    ]
    is_own = bool(states) and group is not None and states[0].group == group
    if not is_own:
        complete = [part for part in parts if part.keys() >= set(joints)]
        if complete:
            return complete[0]
    merged: dict[str, float] = {}
    for part in parts:
        if all(merged.get(joint, value) == value for joint, value in part.items()):
            merged |= part
        elif not is_own:
            return {}
    return merged if is_own or merged.keys() >= set(joints) else {}


def find_srdf(file: Path) -> Path | None:
    """Return the SRDF of a robot's or home's file by its name, beside it or in ../srdf, or None."""
    name = file.name.split(".")[0]
    places = [
        folder / f"{stem}.srdf"
        for stem in dict.fromkeys((file.stem, name, name.removesuffix("_robot")))
        for folder in (file.parent, file.parent.parent / "srdf")
    ]
    return next((place for place in places if place.is_file()), None)


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
    states, stateless = _read_states(root, tree)
    unknown_joints = dict.fromkeys((*groups.unknown_joints, *stateless)).keys() - virtual_joints
    skipped = {
        "links": dict.fromkeys((*pairs.unknown, *groups.unknown_links)),
        "joints": sorted(unknown_joints),
    }
    notes = [
        f"skipped {kind} that the robot does not have: {format_names(names)}"
        for kind, names in skipped.items()
        if names
    ]
    if groups.invalid:
        notes.append(f"skipped groups of groups that are missing: {format_names(groups.invalid)}")
    return Srdf(pairs.allowed, states, groups.groups, tuple(notes))


def _find_link_references(root: ElementTree.Element) -> set[str]:
    """Return all names of links in an SRDF."""
    names = {element.get(key, "") for element in root.iter() for key in _LINK_ATTRIBUTES}
    names |= {element.get("name", "") for element in root.iter("link")}
    return {name.strip() for name in names} - {""}


def read_allowed_pairs(path: str | Path, models: Sequence[Collection[str]]) -> AllowedPairs:
    """Read only the allowed collisions of an SRDF file.

    Args:
        path: The file.
        models: Names of the links of each model. `<disable_default_collisions>` of a link concerns
            its pairs with links of the same model.
    """
    return _read_pairs(read_xml(path, "SRDF")[1], models)


def _read_pairs(root: ElementTree.Element, models: Sequence[Collection[str]]) -> AllowedPairs:
    """Return the allowed pairs; the most specific element counts, and allowing before checking.

    As in MoveIt, `<disable_default_collisions>` allows all pairs of a link, `<enable_collisions>`
    checks some of these nevertheless, and `<disable_collisions>` allows a pair in any case.
    """
    known = {link for model in models for link in model}
    unknown: dict[str, int | None] = {}
    allowed: dict[Pair, str] = {}
    for element in root.findall("disable_default_collisions"):
        link = element.get("link", "").strip()
        if link not in known:
            unknown.setdefault(link, find_line(element))
            continue
        for model in models:
            others = (other for other in model if other != link and link in model)
            allowed.update((_sort_pair(link, other), "Default") for other in others)
    for tag in ("enable_collisions", "disable_collisions"):
        for element in root.findall(tag):
            one, other = (element.get(key, "").strip() for key in ("link1", "link2"))
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
        self.links = dict.fromkeys(link.get("name", "") for link in urdf.findall("link")).keys()
        self.moved: dict[str, str] = {}  # joint → its child link
        self.above: dict[str, tuple[str, str]] = {}  # child link → its joint and parent link
        for joint in urdf.findall("joint"):
            ends = [joint.find(key) for key in ("parent", "child")]
            parent, child = (end.get("link", "") if end is not None else "" for end in ends)
            name = joint.get("name", "")
            self.moved[name] = child
            self.above[child] = (name, parent)

    def list_ancestors(self, link: str) -> list[str]:
        """Return a link and those above it, up to the root."""
        found = [link]
        while found[-1] in self.above and len(found) <= len(self.links):
            found.append(self.above[found[-1]][1])
        return found

    def find_chain(self, base: str, tip: str) -> list[str]:
        """Return the joints between two links, by their nearest common ancestor."""
        from_base, from_tip = self.list_ancestors(base), self.list_ancestors(tip)
        apart = [link for link in from_base if link not in from_tip]
        apart += [link for link in reversed(from_tip) if link not in from_base]
        return [self.above[link][0] for link in apart if link in self.above]


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
        moved_by_group: dict[str, dict[str, str]] = {}
        while True:
            ready = [
                name
                for name, element in waiting.items()
                if moved_by_group.keys() >= set(_read_names(element, "group"))
            ]
            if not ready:
                break
            for name in ready:
                element = waiting.pop(name)
                moved_by_group[name] = self._find_moved_links(element)
                for part in _read_names(element, "group"):
                    moved_by_group[name] |= moved_by_group[part]
        self.invalid = list(waiting)
        self.groups = {
            name: SrdfGroup(tuple(moved), self._find_tip(moved))
            for name, moved in moved_by_group.items()
            if moved
        }

    def _find_moved_links(self, group: ElementTree.Element) -> dict[str, str]:
        """Return the joints of a group with the links that they move, without other groups."""
        tree = self._tree
        moved: dict[str, str] = {}
        for link in _read_names(group, "link"):
            if link not in tree.links:
                self.unknown_links[link] = None
            elif link in tree.above:  # the root has no parent joint
                moved[tree.above[link][0]] = link
        for joint in _read_names(group, "joint"):
            if joint in tree.moved:
                moved[joint] = tree.moved[joint]
            else:
                self.unknown_joints[joint] = None
        for chain in group.findall("chain"):
            ends = [chain.get(key, "").strip() for key in ("base_link", "tip_link")]
            missing = [link for link in ends if link not in tree.links]
            self.unknown_links.update(dict.fromkeys(missing))
            if not missing:
                moved |= {joint: tree.moved[joint] for joint in tree.find_chain(*ends)}
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
    states, unknown = list[SrdfState](), dict[str, None]()
    for element in root.findall("group_state"):
        positions: dict[str, float] = {}
        for joint in element.findall("joint"):
            name = joint.get("name", "").strip()
            if name not in tree.moved:
                unknown[name] = None
                continue
            try:
                position = float(joint.get("value", ""))
            except ValueError:
                continue  # joints of several coordinates: not ours
            if math.isfinite(position):
                positions[name] = position
        name, group = (element.get(key, "").strip() for key in ("name", "group"))
        states.append(SrdfState(name, group, positions))
    return tuple(states), unknown


def _sort_pair(one: str, other: str) -> Pair:
    return (one, other) if one <= other else (other, one)


def format_names(names: Collection[str]) -> str:
    """Return names as text; "" is an attribute that is missing."""
    listed = ", ".join(name or '""' for name in list(names)[:_LISTED])
    return listed + (f", ... ({len(names)})" if len(names) > _LISTED else "")
