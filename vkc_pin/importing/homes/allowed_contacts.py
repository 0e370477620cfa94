"""Reads the allowed collisions of a home from the SRDF beside its file."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from vkc_pin.errors import InputError
from vkc_pin.importing.description import Description
from vkc_pin.importing.homes.splitting import Home
from vkc_pin.world.files.srdf import AllowedPairs, find_srdf, format_names, read_allowed_pairs
from vkc_pin.world.files.xml import read_xml


@dataclass(frozen=True, eq=False)
class HomeContacts:
    """Pairs of links of a home that may touch.

    Attributes:
        allowed: Pairs of links, each sorted.
        notes: Their source, and skipped names.
    """

    allowed: Collection[tuple[str, str]] = ()
    notes: tuple[str, ...] = ()
    _file: str = field(default="", repr=False)

    def find_scene_pairs(
        self, home: Home, obstacles: Mapping[str, str]
    ) -> tuple[list[list[str]], tuple[str, ...]]:
        """Return pairs of names in the scene, and notes about pairs that it cannot have.

        A name stands for all links that are rigidly connected to one link of an object. Their pair
        is allowed if the pairs of all these links are.

        Args:
            home: The divided home.
            obstacles: Link of each obstacle by the name of the obstacle.
        """
        if not self.allowed:
            return [], ()
        links_by_label = _find_links_of_objects(home)
        moving = set(links_by_label)
        for name, link in obstacles.items():
            links_by_label[name] = {link}
        counts = self._count_link_pairs(links_by_label)
        pairs = list[list[str]]()
        partial = list[str]()
        for (one, other), count in sorted(counts.items()):
            # Pairs within an object, and pairs of obstacles, are never checked.
            is_moving = one in moving or other in moving
            is_same_object = one.split(".")[0] == other.split(".")[0]
            if not is_moving or is_same_object:
                continue
            if count == len(links_by_label[one]) * len(links_by_label[other]):
                pairs.append([one, other])
            else:
                partial.append(f"{one} – {other}")
        notes = list[str]()
        if pairs:
            notes.append(f"{self._file}: {len(pairs)} pairs that may touch are in `allow`")
        if partial:
            text = "not in `allow`, as only some of their links may touch"
            notes.append(f"{self._file}: {text}: {format_names(partial)}")
        return pairs, tuple(notes)

    def _count_link_pairs(
        self, links_by_label: Mapping[str, Collection[str]]
    ) -> dict[tuple[str, str], int]:
        """Return the number of allowed pairs of links for each pair of names in the scene."""
        labels_by_link = dict[str, list[str]]()
        for label, links in links_by_label.items():
            for link in links:
                labels_by_link.setdefault(link, []).append(label)
        counts = dict[tuple[str, str], int]()
        for one, other in self.allowed:
            for first in labels_by_link.get(one, ()):
                for second in labels_by_link.get(other, ()):
                    pair = (min(first, second), max(first, second))
                    counts[pair] = counts.get(pair, 0) + 1
        return counts


def read_home_contacts(
    file: Path, srdf: Path | None, links: Collection[str], names: Collection[str]
) -> HomeContacts:
    """Read the SRDF of a home.

    Args:
        file: The home's file.
        srdf: The SRDF. Default: that beside the file or in ../srdf, if there is one.
        links: Links of the file.
        names: Their names in the scene, in the same order.

    Raises:
        InputError: The given SRDF cannot be read, or names no link of the home.
    """
    path = find_srdf(file) if srdf is None else srdf
    if path is None:
        return HomeContacts()
    try:
        pairs = read_allowed_pairs(path, [links])
        _check_links(path, pairs, links)
        _, root = read_xml(path, "SRDF")
        handles = [handle.get("name", "") for handle in root.iter("handle")]
    except InputError as error:
        if srdf is not None:
            raise
        return HomeContacts(notes=(f"ignored {path.name} beside it: {error.problem}",))
    renamed = dict(zip(links, names, strict=True))
    allowed = [(renamed[one], renamed[other]) for one, other in pairs.allowed]
    notes = list[str]()
    if pairs.unknown:
        skipped = format_names(pairs.unknown)
        notes.append(f"{path.name}: skipped links that the home does not have: {skipped}")
    if handles:
        text = "its handles are not used, attachments are proposed from the shapes"
        notes.append(f"{path.name}: {text}: {format_names(handles)}")
    return HomeContacts(allowed, tuple(notes), path.name)


def _check_links(path: Path, pairs: AllowedPairs, links: Collection[str]) -> None:
    if pairs.unknown and not pairs.allowed:
        raise InputError(
            "the SRDF names no pair of links of this home",
            file=path,
            field="disable_collisions",
            expected=f"links such as {format_names(list(links)[:2])}",
            got=format_names(pairs.unknown),
        )


def _find_links_of_objects(home: Home) -> dict[str, set[str]]:
    """Return the links with shapes, by the name in the scene of the link that carries them."""
    links_by_label = dict[str, set[str]]()
    for item in home.objects:
        for name, link in item.description.links.items():
            if link.solid:
                label = f"{item.name}.{_find_carrier(item.description, name)}"
                links_by_label.setdefault(label, set()).add(name)
    return links_by_label


def _find_carrier(description: Description, link: str) -> str:
    """Return the link to which fixed joints connect a link: merging leaves only this one."""
    while link in description.joints and description.joints[link].kind == "fixed":
        link = description.joints[link].parent
    return link
