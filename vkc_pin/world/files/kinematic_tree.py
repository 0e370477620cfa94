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
    is_limited = joint.get("type") in _LIMITED_TYPES
    limits = joint.findall("limit")
    if is_limited and not limits:
        problem = f"a {joint.get('type')} joint without limits"
        raise make_element_error(file, joint, problem, field=name, expected="<limit>")
    for limit in limits:
        lower = _parse_limit(file, name, limit, "lower")
        upper = _parse_limit(file, name, limit, "upper")
        velocity = _parse_limit(file, name, limit, "velocity")
        effort = _parse_limit(file, name, limit, "effort")
        for key, value in (("velocity", velocity), ("effort", effort)):
            if value < 0.0 or 0.0 < value < MIN_POSITIVE:
                raise make_element_error(
                    file,
                    limit,
                    f"{key} limit out of range",
                    field=f"{name}: limit {key}",
                    expected=f"{MIN_POSITIVE:g} or more, or 0 for none",
                    got=f"{value:g}",
                )
        if is_limited and lower > upper:
            raise make_element_error(
                file,
                limit,
                "limits in the wrong order",
                field=f"{name}: limit",
                expected="lower ≤ upper",
                got=f"{lower:g} and {upper:g}",
            )


def check_tree(file: Path, root: ElementTree.Element) -> None:
    """Check that links and joints form one tree, with valid names, types and numbers.

    Position limits beyond `MAX_COORDINATE`, such as the largest floats, mean none: revolute joints
    that have only such limits become continuous.
    """
    for element in root.iter():
        if element.tag.startswith("xacro:") and element.tag not in _XACRO_DEFINITIONS:
            raise make_element_error(
                file,
                element,
                "xacro has not been run",
                expected="a plain URDF: xacro FILE > robot.urdf",
                got=f"<{element.tag}>",
            )
    links = _index_by_name(file, root, "link")
    if not links:
        raise InputError("there are no links", file=file, expected="<link> elements")
    parents: dict[str, tuple[str, str]] = {}  # link → its parent, and the joint between
    joints = _index_by_name(file, root, "joint")
    for name, joint in joints.items():
        _check_joint(file, name, joint, joints)
        parent = _find_link(file, name, joint, "parent", links)
        child = _find_link(file, name, joint, "child", links)
        if child in parents:
            _, other_joint = parents[child]
            raise make_element_error(
                file,
                joint,
                "a link with two parents",
                field=child,
                expected="one joint",
                got=f"joints '{other_joint}' and '{name}'",
            )
        parents[child] = (parent, name)
        if joint.get("type") == "revolute" and _has_no_limits(file, name, joint):
            joint.set("type", "continuous")
    lines = {name: find_line(link) for name, link in links.items()}
    roots = list(dict.fromkeys(find_roots(file, lines, parents).values()))
    if len(roots) > 1:
        second = roots[1]
        raise make_element_error(
            file,
            links[second],
            "links that nothing connects",
            field=second,
            expected="one root",
            got=", ".join(roots[:5]),
        )


def simplify_tree(file: Path, root: ElementTree.Element) -> tuple[str, frozenset[str]]:
    """Return a URDF of a checked tree without shapes, extensions and mimic elements.

    Missing limits are 0. Warns about an incomplete <inertial>, which is dropped.

    Returns:
        The URDF, and the joints without a velocity limit.
    """
    plain = ElementTree.Element("robot", name=root.get("name") or replace_forbidden(file.stem))
    for link in root.findall("link"):
        plain_link = ElementTree.SubElement(plain, "link", name=link.get("name", ""))
        inertial = link.find("inertial")
        if inertial is not None:
            _add_inertial(file, plain_link, inertial)
    without_velocity = set[str]()
    for joint in root.findall("joint"):
        name = joint.get("name", "")
        kind = joint.get("type", "")
        plain_joint = ElementTree.SubElement(plain, "joint", name=name, type=kind)
        origin = joint.find("origin")
        if origin is not None:
            _add_origin(file, plain_joint, origin, name)
        for key in ("parent", "child"):
            end = joint.find(key)
            if end is not None:
                ElementTree.SubElement(plain_joint, key, link=end.get("link", ""))
        if kind in _TYPES_WITHOUT_AXIS:
            continue
        axis = joint.find("axis")
        if axis is not None:
            direction = parse_numbers(file, axis, "xyz", 3, default="1 0 0", where=name)
            ElementTree.SubElement(plain_joint, "axis", xyz=_format_numbers(direction))
        limit = joint.find("limit")
        if limit is not None:
            _add_limit(file, plain_joint, limit)
            if limit.get("velocity") is None:
                without_velocity.add(name)
    return ElementTree.tostring(plain, encoding="unicode"), frozenset(without_velocity)


def _add_origin(
    file: Path, joint: ElementTree.Element, origin: ElementTree.Element, where: str
) -> None:
    position = parse_numbers(file, origin, "xyz", 3, default="0 0 0", where=where)
    angles = parse_numbers(file, origin, "rpy", 3, default="0 0 0", where=where)
    ElementTree.SubElement(
        joint, "origin", xyz=_format_numbers(position), rpy=_format_numbers(angles)
    )


def _add_limit(file: Path, joint: ElementTree.Element, limit: ElementTree.Element) -> None:
    name = joint.get("name", "")
    has_range = limit.get("lower") is not None or limit.get("upper") is not None
    if joint.get("type") in _LIMITED_TYPES and not has_range:
        warnings.warn(
            f"{file}:{find_line(limit)}: {name}: a limit without lower and upper: it cannot move",
            stacklevel=3,
        )
    values = {}
    for key in ("lower", "upper", "velocity", "effort"):
        values[key] = _format_numbers((_parse_limit(file, name, limit, key),))
    ElementTree.SubElement(joint, "limit", values)


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
    inertia = ElementTree.SubElement(added, "inertia")
    for key, moment in zip(MOMENTS, moments, strict=True):
        inertia.set(key, _format_numbers((moment,)))


def parse_origin(
    file: Path, element: ElementTree.Element, where: str
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return position [m] and roll, pitch, yaw [rad] of an element's <origin>, or zeros."""
    origin = element.find("origin")
    if origin is None:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    position = parse_numbers(file, origin, "xyz", 3, default="0 0 0", where=where)
    angles = parse_numbers(file, origin, "rpy", 3, default="0 0 0", where=where)
    return position, angles


def parse_inertial(
    file: Path, inertial: ElementTree.Element, where: str
) -> tuple[float, tuple[float, ...], tuple[tuple[float, ...], tuple[float, ...]]]:
    """Return mass [kg], moments [kg·m²] in the order of `MOMENTS`, and origin of an <inertial>."""
    mass = inertial.find("mass")
    if mass is None:
        raise make_element_error(file, inertial, "an <inertial> without <mass>", field=where)
    inertia = inertial.find("inertia")
    if inertia is None:
        raise make_element_error(file, inertial, "an <inertial> without <inertia>", field=where)
    (value,) = parse_numbers(file, mass, "value", 1, default=None, where=where, largest=_MAX_MASS)
    if value < 0.0:
        raise make_element_error(
            file, mass, "a negative mass", field=where, expected="0 kg or more", got=value
        )
    moments = list[float]()
    for key in MOMENTS:
        moments += parse_numbers(file, inertia, key, 1, default="0", where=where, largest=_MAX_MASS)
    return value, tuple(moments), parse_origin(file, inertial, where)


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
    stated = element.get(key, default)
    text = stated or ""
    # Commas count between all numbers only: in "0,5 1" it would be a decimal point.
    by_comma = [part.strip() for part in text.strip().rstrip(",").split(",")]
    has_commas = len(by_comma) == count > 1
    parts = by_comma if has_commas else text.split()
    try:
        values = tuple(map(float, parts))
    except ValueError:
        values = ()
    has_count = len(values) == count
    all_finite = all(map(math.isfinite, values))
    in_range = all(abs(value) <= largest for value in values)
    if not has_count or not in_range or (is_finite and not all_finite):
        expected = "1 finite number"
        if count > 1:
            expected = f"{count} finite numbers with spaces between them"
        if values and has_count and all_finite:
            expected = f"at most {largest:g}"
        raise make_element_error(
            file,
            element,
            "wrong numbers",
            field=f"{where}: {element.tag} {key}",
            expected=expected,
            got=stated,
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


def _parse_limit(file: Path, name: str, limit: ElementTree.Element, key: str) -> float:
    (value,) = parse_numbers(file, limit, key, 1, default="0", where=name, largest=math.inf)
    if key in ("lower", "upper"):
        value = min(max(value, -MAX_COORDINATE), MAX_COORDINATE)
    return value


def _has_no_limits(file: Path, name: str, joint: ElementTree.Element) -> bool:
    """Return whether both limits of a joint are so large that they mean none."""
    for limit in joint.findall("limit"):
        lower = _parse_limit(file, name, limit, "lower")
        upper = _parse_limit(file, name, limit, "upper")
        if abs(lower) < MAX_COORDINATE or abs(upper) < MAX_COORDINATE:
            return False
    return True


def _check_joint(
    file: Path, name: str, joint: ElementTree.Element, joints: Collection[str]
) -> None:
    kind = joint.get("type")
    if kind not in _JOINT_TYPES:
        problem = "this joint type is not supported"
        expected = ", ".join(_JOINT_TYPES)
        raise make_element_error(file, joint, problem, field=name, expected=expected, got=kind)
    for origin in joint.findall("origin"):
        for key in ("xyz", "rpy"):
            parse_numbers(file, origin, key, 3, default="0 0 0", where=name)
    axes = [] if kind in _TYPES_WITHOUT_AXIS else joint.findall("axis")
    for axis in axes:
        direction = parse_numbers(file, axis, "xyz", 3, default="1 0 0", where=name)
        if not math.hypot(*direction) > 0.0:
            problem = "an axis without direction"
            raise make_element_error(file, axis, problem, field=name, got=axis.get("xyz"))
    _check_limits(file, name, joint)
    for mimic in joint.findall("mimic"):
        leader = mimic.get("joint", "")
        # Published robots have couplings to joints that do not exist.
        if leader not in joints:
            warnings.warn(
                f"{file}:{find_line(mimic)}: {name}: there is no joint '{leader}' to follow",
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
        if not path:
            continue
        last = path[-1]
        if last in path[:-1]:
            circle = path[path.index(last) :]
            raise InputError(
                "links in a circle",
                file=file,
                line=lines[link],
                field=link,
                expected="a tree",
                got=" → ".join(circle[::-1]),
            )
        parent, _ = above[last]
        roots.update(dict.fromkeys(path, roots[parent]))
    return {link: roots[link] for link in lines}


def _walk_to_root(
    link: str, above: Mapping[str, tuple[str, str]], reaches: Collection[str]
) -> Iterator[str]:
    """Yield a link and its ancestors, up to a link in `reaches` or the first repeated one."""
    visited = set[str]()
    while link not in reaches:
        yield link
        if link in visited:
            return
        visited.add(link)
        link, _ = above[link]
