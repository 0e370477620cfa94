"""Checks of the links and joints of a URDF: they make one tree, of numbers that mean something.

Parsers take that for granted: a circle of links never ends, a link with two parents gets one of them without a word, and an
origin that is no number becomes none.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from pathlib import Path

from vkc_pin.arrays import LARGEST
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.files.xml import line_of

__all__ = ["check_tree", "numbers_of"]

_KINDS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
_LIMITED = ("revolute", "prismatic")
_WITHOUT_AXIS = ("fixed", "floating")


def check_tree(file: Path, root: ElementTree.Element) -> None:
    """Check that links and joints make one tree.

    Raises:
        InputError: A name is missing or given twice, a link has two parents or goes in a circle, there are several roots or
            none, a joint's type, origin, axis or limit is wrong.
        UnknownNameError: A joint names a link that does not exist.
    """
    links = _named(file, root, "link")
    if not links:
        raise InputError("there are no links", file=file, expected="<link> elements")
    above: dict[str, tuple[str, str]] = {}  # link → its parent, and the joint between
    for name, joint in _named(file, root, "joint").items():
        _check_joint(file, name, joint)
        parent, child = (_link(file, name, joint, key, links) for key in ("parent", "child"))
        if child in above:
            got, line = f"joints '{above[child][1]}' and '{name}'", line_of(joint)
            raise InputError("a link with two parents", file=file, line=line, field=child, expected="one joint", got=got)
        above[child] = parent, name
    _check_roots(file, links, above)


def numbers_of(
    file: Path,
    element: ElementTree.Element,
    key: str,
    count: int,
    *,
    default: str | None,
    where: str,
    largest: float = LARGEST,
) -> tuple[float, ...]:
    """Return numbers in an attribute of an element.

    Args:
        file: The URDF.
        element: The element.
        key: The attribute.
        count: How many there have to be.
        default: What holds where there is none; None: there has to be one.
        where: What the element belongs to, for messages.
        largest: None may be larger, or less than the negative of it.

    Raises:
        InputError: There are more or less of them, or one is no number, infinite or too large.
    """
    text = element.get(key, default)
    try:
        values = tuple(float(part) for part in (text or "").split())
    except ValueError:
        values = ()
    if len(values) != count or not all(math.isfinite(value) and abs(value) <= largest for value in values):
        field, expected = f"{where}: {element.tag} {key}", f"{count} finite number{'s' * (count > 1)}"
        if values and len(values) == count and all(map(math.isfinite, values)):
            expected = f"at most {largest:g}"
        raise InputError("wrong numbers", file=file, line=line_of(element), field=field, expected=expected, got=text)
    return values


def _named(file: Path, root: ElementTree.Element, tag: str) -> dict[str, ElementTree.Element]:
    """Return the elements of a kind by their names."""
    found: dict[str, ElementTree.Element] = {}
    for element in root.findall(tag):
        name = element.get("name", "")
        if not name.strip():
            raise InputError(f"a {tag} without a name", file=file, line=line_of(element), expected=f'<{tag} name="...">')
        if name in found:
            got = f"lines {line_of(found[name])} and {line_of(element)}"
            raise InputError(f"two {tag}s of one name", file=file, line=line_of(element), field=name, got=got)
        found[name] = element
    return found


def _link(file: Path, name: str, joint: ElementTree.Element, key: str, links: Mapping[str, ElementTree.Element]) -> str:
    """Return the link that a joint names as its "parent" or "child"."""
    element = joint.find(key)
    if element is None or element.get("link") is None:
        raise InputError(
            "a joint that connects nothing", file=file, line=line_of(joint), field=name, expected=f'<{key} link="...">'
        )
    link = element.get("link", "")
    if link not in links:
        raise UnknownNameError("link", link, links, file=file, line=line_of(element), field=f"{name}: {key}")
    return link


def _check_joint(file: Path, name: str, joint: ElementTree.Element) -> None:
    kind, line = joint.get("type"), line_of(joint)
    if kind not in _KINDS:
        expected = ", ".join(_KINDS)
        raise InputError("this joint type is not supported", file=file, line=line, field=name, expected=expected, got=kind)
    for origin in joint.findall("origin"):
        for key in ("xyz", "rpy"):
            numbers_of(file, origin, key, 3, default="0 0 0", where=name)
    for axis in joint.findall("axis") if kind not in _WITHOUT_AXIS else ():
        if not math.hypot(*numbers_of(file, axis, "xyz", 3, default="1 0 0", where=name)) > 0.0:
            line = line_of(axis)
            raise InputError("an axis without direction", file=file, line=line, field=name, got=axis.get("xyz"))
    limits = joint.findall("limit")
    if kind in _LIMITED and not limits:
        raise InputError(f"a {kind} joint without limits", file=file, line=line, field=name, expected="<limit>")
    for limit in limits:
        keys = ("lower", "upper", "velocity", "effort")
        lower, upper, _, _ = (numbers_of(file, limit, key, 1, default="0", where=name, largest=math.inf)[0] for key in keys)
        if kind in _LIMITED and lower > upper:
            field, got, line = f"{name}: limit", f"{lower:g} and {upper:g}", line_of(limit)
            problem = "limits in the wrong order"
            raise InputError(problem, file=file, line=line, field=field, expected="lower ≤ upper", got=got)


def _check_roots(file: Path, links: Mapping[str, ElementTree.Element], above: Mapping[str, tuple[str, str]]) -> None:
    """Check that all links hang on one."""
    roots = [link for link in links if link not in above]
    if len(roots) > 1:
        got, line = ", ".join(roots[:5]), line_of(links[roots[1]])
        raise InputError("links that nothing connects", file=file, line=line, field=roots[1], expected="one root", got=got)
    reaches = set(roots)
    for link in links:
        path = list(_up(link, above, reaches))
        if path and path[-1] in path[:-1]:
            circle = path[path.index(path[-1]) :]
            line = line_of(links[link])
            raise InputError(
                "links in a circle", file=file, line=line, field=link, expected="a tree", got=" → ".join(circle[::-1])
            )
        reaches.update(path)


def _up(link: str, above: Mapping[str, tuple[str, str]], reaches: set[str]) -> Iterator[str]:
    """Yield a link and those it hangs on, up to one that `reaches` the root, or to one for the second time."""
    passed: set[str] = set()
    while link not in reaches:
        yield link
        if link in passed:
            return
        passed.add(link)
        link = above[link][0]
