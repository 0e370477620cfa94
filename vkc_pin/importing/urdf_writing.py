"""Converts descriptions to URDF."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.importing.description import MOVING_KINDS, Coupling, Description, Joint, Part
from vkc_pin.utils.arrays import MAX_COORDINATE
from vkc_pin.world.files.kinematic_tree import MOMENTS
from vkc_pin.world.files.xml import replace_forbidden

_AXES = "xyz"
_IDENTITY = pin.SE3.Identity()
_DIGITS = 12  # after the point: of metres and radians, far below what matters


def make_urdf(
    description: Description, name: str, folder: Path | None = None
) -> ElementTree.Element:
    """Return a description as a URDF.

    A joint without a stated velocity or effort limit gets 0, which means none: other programs
    require both.

    Args:
        description: The description. Each mesh is in a file; couplings are linear, one at most for
            each joint.
        name: Name of the robot or object.
        folder: Folder of the URDF, in which addresses of meshes are relative; others are absolute.
    """
    root = ElementTree.Element("robot", name=replace_forbidden(name))
    for link in description.links.values():
        element = ElementTree.SubElement(root, "link", name=replace_forbidden(link.name))
        for part in link.visual:
            visual = _add_shape(element, "visual", part, folder)
            _add_material(visual, part)
        for part in link.collision:
            _add_shape(element, "collision", part, folder)
        _add_inertia(element, link.inertia)
    couplings = {coupling.joint: coupling for coupling in description.couplings}
    for joint in description.joints.values():
        _add_joint(root, joint, couplings.get(joint.name))
    return root


def add_connection(
    root: ElementTree.Element, name: str, kind: str, parent: str, child: str, placement: pin.SE3
) -> ElementTree.Element:
    """Add a joint to a URDF and return it."""
    joint = ElementTree.SubElement(root, "joint", name=replace_forbidden(name), type=kind)
    _add_origin(joint, placement)
    ElementTree.SubElement(joint, "parent", link=replace_forbidden(parent))
    ElementTree.SubElement(joint, "child", link=replace_forbidden(child))
    return joint


def _add_shape(
    link: ElementTree.Element, tag: str, part: Part, folder: Path | None
) -> ElementTree.Element:
    """Add a <visual> or <collision> to a link and return it."""
    shape = ElementTree.SubElement(link, tag)
    if part.name:
        shape.set("name", replace_forbidden(part.name))
    _add_origin(shape, part.placement)
    geometry = ElementTree.SubElement(shape, "geometry")
    if part.file is not None:
        file = part.file
        is_inside = folder is not None and file.is_relative_to(folder)
        address = file.relative_to(folder).as_posix() if is_inside and folder else str(file)
        mesh = ElementTree.SubElement(geometry, "mesh", filename=address)
        if part.size != (1.0, 1.0, 1.0):
            mesh.set("scale", _format_numbers(part.size))
    elif part.kind == "box":
        ElementTree.SubElement(geometry, "box", size=_format_numbers(part.size))
    else:
        solid = ElementTree.SubElement(geometry, part.kind)
        for key, value in zip(("radius", "length"), part.size, strict=False):
            solid.set(key, _format_numbers([value]))
    return shape


def _add_material(visual: ElementTree.Element, part: Part) -> None:
    """Add the colour of a shape, with a name that equal colours share."""
    if part.colour is None:
        return
    name = "_".join(f"{round(255 * value):02x}" for value in part.colour)
    material = ElementTree.SubElement(visual, "material", name=name)
    ElementTree.SubElement(material, "color", rgba=_format_numbers(part.colour))


def _add_inertia(link: ElementTree.Element, inertia: pin.Inertia) -> None:
    """Add a link's inertia about its centre of mass, along the link's axes."""
    if not inertia.mass > 0.0:
        return
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=_format_numbers(inertia.lever))
    ElementTree.SubElement(inertial, "mass", value=f"{inertia.mass:.12g}")
    moments = ElementTree.SubElement(inertial, "inertia")
    for key in MOMENTS:
        row = _AXES.index(key[1])
        column = _AXES.index(key[2])
        moments.set(key, f"{inertia.inertia[row, column]:.12g}")


def _add_joint(root: ElementTree.Element, joint: Joint, coupling: Coupling | None) -> None:
    element = add_connection(
        root, joint.name, joint.kind, joint.parent, joint.child, joint.placement
    )
    if joint.kind not in MOVING_KINDS:
        return
    ElementTree.SubElement(element, "axis", xyz=_format_numbers(joint.axis))
    limit = ElementTree.SubElement(element, "limit")
    if joint.limits is not None:
        lower, upper = np.clip(joint.limits, -MAX_COORDINATE, MAX_COORDINATE)
        limit.set("lower", _format_numbers([lower]))
        limit.set("upper", _format_numbers([upper]))
    limit.set("velocity", _format_numbers([joint.velocity or 0.0]))
    limit.set("effort", _format_numbers([joint.effort or 0.0]))
    if joint.damping or joint.friction:
        dynamics = ElementTree.SubElement(element, "dynamics")
        dynamics.set("damping", _format_numbers([joint.damping]))
        dynamics.set("friction", _format_numbers([joint.friction]))
    if coupling is not None and coupling.leader is not None:
        mimic = ElementTree.SubElement(element, "mimic", joint=replace_forbidden(coupling.leader))
        mimic.set("multiplier", _format_numbers([coupling.factor]))
        mimic.set("offset", _format_numbers([coupling.offset]))


def _add_origin(element: ElementTree.Element, placement: pin.SE3) -> None:
    """Add the <origin> of an element that is not at the origin of its frame."""
    if placement == _IDENTITY:
        return
    xyz = _format_numbers(placement.translation)
    rpy = _format_numbers(pin.rpy.matrixToRpy(placement.rotation))
    ElementTree.SubElement(element, "origin", xyz=xyz, rpy=rpy)


def _format_numbers(values: Iterable[Any]) -> str:
    """Format numbers without negative zeros."""
    rounded = np.asarray(values, float).round(_DIGITS) + 0.0
    return " ".join(f"{value:.{_DIGITS}g}" for value in rounded.tolist())
