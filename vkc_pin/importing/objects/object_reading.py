"""Reads an object or a home: a tree of links with independent joints."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from vkc_pin.importing.description import MOVING_KINDS, Description
from vkc_pin.importing.formats.reading import read_description
from vkc_pin.importing.objects.mechanisms import dissolve_mechanisms

WEIGHTLESS = (
    "no mass is stated: arm torques ignore weight and inertia, and simulation assumes a density"
)
"""Note about an object whose file states no masses."""


def read_object(
    file: str | Path,
    *,
    free: bool = False,
    packages: Mapping[str, str | Path] | None = None,
    arguments: Mapping[str, str] | None = None,
) -> Description:
    """Read an object or a home from a file; see `read_description`.

    Args:
        file: The file.
        free: Whether to keep free bodies, on floating joints; otherwise those beside others are
            left out.
        packages: Folders of packages by name; others are searched for around the file.
        arguments: Arguments of a xacro file.
    """
    description = read_description(file, packages=packages, arguments=arguments)
    return simplify_object(description, free=free)


def simplify_object(
    description: Description,
    *,
    free: bool = False,
    positions: Mapping[str, float] | None = None,
) -> Description:
    """Return an object or a home as a tree of links with independent joints, noting changes.

    Args:
        description: The object as it was read.
        free: Whether to keep free bodies; see `read_object`.
        positions: Positions of joints that become fixed, by name, [rad] or [m]; others are at zero.
    """
    description = description.add_notes(*description.warnings)
    description = dissolve_mechanisms(description, positions)
    if not free:
        description = _remove_free_bodies(description)
    description = _fix_other_joints(description)
    return _forget_infinite_limits(description).clip_resistances()


def _remove_free_bodies(description: Description) -> Description:
    """Return an object without the free bodies beside it, with a note about each.

    If there is nothing but one free body, it is the object.
    """
    free = [child for child, joint in description.joints.items() if joint.kind == "floating"]
    gone = set[str]()
    for child in free:
        gone |= description.subtree(child)
    links = {name: link for name, link in description.links.items() if name not in gone}
    is_alone = not any(link.solid for link in links.values())
    if is_alone and len(free) == 1:
        return description.extract_subtree(free[0])
    joints = {child: joint for child, joint in description.joints.items() if child not in gone}
    notes = [f"body '{child}' is free, hence a separate object: left out" for child in free]
    return description.add_notes(*notes).keep(links, joints)


def _fix_other_joints(description: Description) -> Description:
    """Return an object whose joints of other kinds are fixed, with a note about each."""
    joints = dict(description.joints)
    notes = list[str]()
    for child, joint in description.joints.items():
        if joint.kind not in ("fixed", *MOVING_KINDS, "floating"):
            notes.append(f"joint '{joint.name}' is {joint.kind}: taken as fixed")
            joints[child] = replace(joint, kind="fixed", limits=None)
    return replace(description.add_notes(*notes), joints=joints)


def _forget_infinite_limits(description: Description) -> Description:
    """Return an object whose joints without end have no limits: imports choose some."""
    joints = dict(description.joints)
    for child, joint in description.joints.items():
        if joint.limits is not None and all(map(math.isinf, joint.limits)):
            joints[child] = replace(joint, limits=None)
    return replace(description, joints=joints)
