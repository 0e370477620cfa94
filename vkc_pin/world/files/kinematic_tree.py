"""Checks that the links and joints of a URDF form one tree with valid numbers.

Parsers assume that: they hang in circles, ignore second parents, and drop invalid origins. They
also reject files for extensions or missing numbers that planning does not need. They are given a
simplified URDF of checked links and joints.
"""

from __future__ import annotations

import math
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.utils.arrays import MAX_COORDINATE, MIN_POSITIVE
from vkc_pin.world.files.xml import find_line, make_element_error, replace_forbidden

MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
"""Attributes of <inertia>, along the rows of the upper triangle."""
_MAX_MASS = 1e9  # [kg], and of moments of inertia [kg·m²]

_JOINT_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
_LIMITED_TYPES = ("revolute", "prismatic")
_TYPES_WITHOUT_AXIS = ("fixed", "floating")
# Of xacro's elements those that put nothing in their place.
_XACRO_DEFINITIONS = ("xacro:arg", "xacro:property")


def _check_limits(file: Path, name: str, joint: ElementTree.Element) -> None:
    is_limited, limits = joint.get("type") in _LIMITED_TYPES, joint.findall("limit")
    if is_limited and not limits:
        problem = f"a {joint.get('type')} joint without limits"
        raise make_element_error(file, joint, problem, field=name, expected="<limit>")
    for limit in limits:
        keys = ("lower", "upper", "velocity", "effort")
        lower, upper, *rates = (_parse_limit(file, name, limit, key)[0] for key in keys)
        for key, rate in zip(keys[2:], rates, strict=True):
            if rate < 0.0 or 0.0 < rate < MIN_POSITIVE:
                problem, field = f"{key} limit out of range", f"{name}: limit {key}"
                expected = f"{MIN_POSITIVE:g} or more, or 0 for none"
                raise make_element_error(
                    file, limit, problem, field=field, expected=expected, got=f"{rate:g}"
                )
        if is_limited and lower > upper:
            problem, got = "limits in the wrong order", f"{lower:g} and {upper:g}"
            field, expected = f"{name}: limit", "lower ≤ upper"
            raise make_element_error(file, limit, problem, field=field, expected=expected, got=got)


def check_tree(file: Path, root: ElementTree.Element) -> None:
    """Check that links and joints form one tree, with valid names, types and numbers.

    Position limits beyond `MAX_COORDINATE`, such as the largest floats, mean none: revolute joints
    that have only such limits become continuous.
    """
    for element in root.iter():
        if element.tag.startswith("xacro:") and element.tag not in _XACRO_DEFINITIONS:
            expected, got = "a plain URDF: xacro FILE > robot.urdf", f"<{element.tag}>"
            raise make_element_error(
                file, element, "xacro has not been run", expected=expected, got=got
            )
    links = _index_by_name(file, root, "link")
    if not links:
        raise InputError("there are no links", file=file, expected="<link> elements")
    above: dict[str, tuple[str, str]] = {}  # link → its parent, and the joint between
    joints = _index_by_name(file, root, "joint")
    for name, joint in joints.items():
        _check_joint(file, name, joint, joints)
        parent, child = (_find_link(file, name, joint, key, links) for key in ("parent", "child"))
        if child in above:
            problem, got = "a link with two parents", f"joints '{above[child][1]}' and '{name}'"
            raise make_element_error(
                file, joint, problem, field=child, expected="one joint", got=got
            )
        above[child] = parent, name
        if joint.get("type") == "revolute" and _has_no_limits(file, name, joint):
            joint.set("type", "continuous")
    lines = {name: find_line(link) for name, link in links.items()}
    roots = list(dict.fromkeys(find_roots(file, lines, above).values()))
    if len(roots) > 1:
        problem, got, second = "links that nothing connects", ", ".join(roots[:5]), roots[1]
        raise make_element_error(
            file, links[second], problem, field=second, expected="one root", got=got
        )


def simplify_tree(file: Path, root: ElementTree.Element) -> tuple[str, frozenset[str]]:
    """Return a URDF of a checked tree without shapes, extensions and mimic elements.

    Missing limits are 0. Warns about an incomplete <inertial>, which is dropped.

    Returns:
        The URDF, and the joints without a velocity limit.
    """
    plain = ElementTree.Element("robot", name=root.get("name") or replace_forbidden(file.stem))
    silent = set[str]()
    for link in root.findall("link"):
        added = ElementTree.SubElement(plain, "link", name=link.get("name", ""))
        if (inertial := link.find("inertial")) is not None:
            _add_inertial(file, added, inertial)
    for joint in root.findall("joint"):
        name, kind = joint.get("name", ""), joint.get("type", "")
        added = ElementTree.SubElement(plain, "joint", name=name, type=kind)
        _add_origin(file, added, joint.find("origin"), name)
        for key in ("parent", "child"):
            if (end := joint.find(key)) is not None:
                ElementTree.SubElement(added, key, link=end.get("link", ""))
        if kind not in _TYPES_WITHOUT_AXIS and (axis := joint.find("axis")) is not None:
            ElementTree.SubElement(
                added,
                "axis",
                xyz=_format_numbers(
                    parse_numbers(file, axis, "xyz", 3, default="1 0 0", where=name)
                ),
            )
        if (limit := joint.find("limit")) is not None and kind not in _TYPES_WITHOUT_AXIS:
            silent.update([name] if limit.get("velocity") is None else [])
            if kind in _LIMITED_TYPES and limit.get("lower") is None and limit.get("upper") is None:
                warnings.warn(
                    f"{file}:{find_line(limit)}: {name}: "
                    "a limit without lower and upper: it cannot move",
                    stacklevel=2,
                )
            said = {
                key: _format_numbers(_parse_limit(file, name, limit, key))
                for key in ("lower", "upper", "velocity", "effort")
            }
            ElementTree.SubElement(added, "limit", said)
    return ElementTree.tostring(plain, encoding="unicode"), frozenset(silent)


def _add_origin(
    file: Path, parent: ElementTree.Element, origin: ElementTree.Element | None, where: str
) -> None:
    if origin is not None:
        said = {
            key: _format_numbers(parse_numbers(file, origin, key, 3, default="0 0 0", where=where))
            for key in ("xyz", "rpy")
        }
        ElementTree.SubElement(parent, "origin", said)


def _add_inertial(file: Path, link: ElementTree.Element, inertial: ElementTree.Element) -> None:
    try:
        mass, moments, (position, angles) = parse_inertial(file, inertial, link.get("name", ""))
    except InputError as error:
        warnings.warn(f"{error}: this <inertial> counts as none", stacklevel=2)
        return
    added = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(
        added, "origin", xyz=_format_numbers(position), rpy=_format_numbers(angles)
    )
    ElementTree.SubElement(added, "mass", value=_format_numbers((mass,)))
    ElementTree.SubElement(
        added,
        "inertia",
        {key: _format_numbers((value,)) for key, value in zip(MOMENTS, moments, strict=True)},
    )


def parse_origin(
    file: Path, element: ElementTree.Element, where: str
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return position [m] and roll, pitch, yaw [rad] of an element's <origin>, or zeros."""
    if (origin := element.find("origin")) is None:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    position, angles = (
        parse_numbers(file, origin, key, 3, default="0 0 0", where=where) for key in ("xyz", "rpy")
    )
    return position, angles


def parse_inertial(
    file: Path, inertial: ElementTree.Element, where: str
) -> tuple[float, tuple[float, ...], tuple[tuple[float, ...], tuple[float, ...]]]:
    """Return mass [kg], moments [kg·m²] in the order of `MOMENTS`, and origin of an <inertial>."""
    mass, inertia = inertial.find("mass"), inertial.find("inertia")
    if mass is None or inertia is None:
        lacks = f"an <inertial> without <{'mass' if mass is None else 'inertia'}>"
        raise make_element_error(file, inertial, lacks, field=where)
    (weight,) = parse_numbers(file, mass, "value", 1, default=None, where=where, largest=_MAX_MASS)
    if weight < 0.0:
        raise make_element_error(
            file, mass, "a negative mass", field=where, expected="0 kg or more", got=weight
        )
    moments = tuple(
        parse_numbers(file, inertia, key, 1, default="0", where=where, largest=_MAX_MASS)[0]
        for key in MOMENTS
    )
    return weight, moments, parse_origin(file, inertial, where)


def _format_numbers(values: tuple[float, ...]) -> str:
    return " ".join(map(repr, values))


def parse_numbers(
    file: Path,
    element: ElementTree.Element,
    key: str,
    count: int,
    *,
    default: str | None,
    where: str,
    largest: float = MAX_COORDINATE,
    is_finite: bool = True,
) -> tuple[float, ...]:
    """Return `count` numbers of an attribute.

    Args:
        file: The URDF.
        element: The element.
        key: The attribute.
        count: Required number of values.
        default: Text for a missing attribute; None: the attribute is required.
        where: Link or joint of the element, for messages.
        largest: Largest valid magnitude.
        is_finite: Whether infinite numbers are invalid.
    """
    text = element.get(key, default)
    parts = (text or "").split()
    # Commas count between all numbers only: in "0,5 1" it would be a decimal point.
    by_comma = [part.strip() for part in (text or "").strip().rstrip(",").split(",")]
    if has_commas := len(by_comma) == count > 1:
        parts = by_comma
    try:
        values = tuple(map(float, parts))
    except ValueError:
        values = ()
    is_valid = len(values) == count and all(abs(value) <= largest for value in values)
    if not is_valid or (is_finite and not all(map(math.isfinite, values))):
        field = f"{where}: {element.tag} {key}"
        expected = (
            f"{count} finite numbers with spaces between them" if count > 1 else "1 finite number"
        )
        if values and len(values) == count and all(map(math.isfinite, values)):
            expected = f"at most {largest:g}"
        raise make_element_error(
            file, element, "wrong numbers", field=field, expected=expected, got=text
        )
    if has_commas:
        warnings.warn(f"{file}: {element.tag} {key}: commas are read as spaces", stacklevel=2)
    return values


def _index_by_name(
    file: Path, root: ElementTree.Element, tag: str
) -> dict[str, ElementTree.Element]:
    """Return the elements with a tag by name."""
    found: dict[str, ElementTree.Element] = {}
    for element in root.findall(tag):
        name = element.get("name", "")
        if not name.strip():
            raise make_element_error(
                file, element, f"a {tag} without a name", expected=f'<{tag} name="...">'
            )
        if name in found:
            got = f"lines {find_line(found[name])} and {find_line(element)}"
            raise make_element_error(file, element, f"two {tag}s of one name", field=name, got=got)
        found[name] = element
    return found


def _find_link(
    file: Path,
    name: str,
    joint: ElementTree.Element,
    key: str,
    links: Mapping[str, ElementTree.Element],
) -> str:
    """Return the link that a joint names as its "parent" or "child"."""
    element = joint.find(key)
    if element is None or element.get("link") is None:
        raise make_element_error(
            file, joint, "a joint that connects nothing", field=name, expected=f'<{key} link="...">'
        )
    link = element.get("link", "")
    if link not in links:
        raise UnknownNameError(
            "link", link, links, file=file, line=find_line(element), field=f"{name}: {key}"
        )
    return link


def _parse_limit(file: Path, name: str, limit: ElementTree.Element, key: str) -> tuple[float]:
    (value,) = parse_numbers(file, limit, key, 1, default="0", where=name, largest=math.inf)
    if key in ("lower", "upper"):
        value = min(max(value, -MAX_COORDINATE), MAX_COORDINATE)
    return (value,)


def _has_no_limits(file: Path, name: str, joint: ElementTree.Element) -> bool:
    """Return whether both limits of a joint are so large that they mean none."""
    return all(
        abs(_parse_limit(file, name, limit, key)[0]) == MAX_COORDINATE
        for limit in joint.findall("limit")
        for key in ("lower", "upper")
    )


def _check_joint(
    file: Path, name: str, joint: ElementTree.Element, joints: Collection[str]
) -> None:
    kind = joint.get("type")
    if kind not in _JOINT_TYPES:
        problem, expected = "this joint type is not supported", ", ".join(_JOINT_TYPES)
        raise make_element_error(file, joint, problem, field=name, expected=expected, got=kind)
    for origin in joint.findall("origin"):
        for key in ("xyz", "rpy"):
            parse_numbers(file, origin, key, 3, default="0 0 0", where=name)
    for axis in joint.findall("axis") if kind not in _TYPES_WITHOUT_AXIS else ():
        if not math.hypot(*parse_numbers(file, axis, "xyz", 3, default="1 0 0", where=name)) > 0.0:
            problem, got = "an axis without direction", axis.get("xyz")
            raise make_element_error(file, axis, problem, field=name, got=got)
    _check_limits(file, name, joint)
    for mimic in joint.findall("mimic"):
        if (followed := mimic.get("joint", "")) not in joints:  # occurs in published robots
            warnings.warn(
                f"{file}:{find_line(mimic)}: {name}: there is no joint '{followed}' to follow",
                stacklevel=2,
            )
        for key, default in (("multiplier", "1"), ("offset", "0")):
            parse_numbers(file, mimic, key, 1, default=default, where=name)


def find_roots(
    file: Path, lines: Mapping[str, int | None], above: Mapping[str, tuple[str, str]]
) -> dict[str, str]:
    """Return the root of each link, and check that no links form a circle.

    Args:
        file: The file, for messages.
        lines: Line of each link in `file`.
        above: Parent of each link that has one, and the joint between them.
    """
    roots = {link: link for link in lines if link not in above}
    for link in lines:
        path = list(_walk_to_root(link, above, roots))
        if path and path[-1] in path[:-1]:
            circle = path[path.index(path[-1]) :]
            problem, got = "links in a circle", " → ".join(circle[::-1])
            raise InputError(
                problem, file=file, line=lines[link], field=link, expected="a tree", got=got
            )
        if path:
            roots |= dict.fromkeys(path, roots[above[path[-1]][0]])
    return {link: roots[link] for link in lines}


def _walk_to_root(
    link: str, above: Mapping[str, tuple[str, str]], reaches: Collection[str]
) -> Iterator[str]:
    """Yield a link and its ancestors, up to a link in `reaches` or the first repeated one."""
    passed: set[str] = set()
    while link not in reaches:
        yield link
        if link in passed:
            return
        passed.add(link)
        link = above[link][0]
