"""Reads URDF files of things without a root joint into Pinocchio models with convex collision geometry."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import coal
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.meshes import load_convex

__all__ = ["UrdfTree", "load_urdf"]

_CONVEX = (coal.Box, coal.Sphere, coal.Cylinder, coal.Capsule, coal.Cone, coal.Ellipsoid, coal.ConvexBase)


@dataclass(frozen=True, eq=False)
class UrdfTree:
    """A URDF as Pinocchio models: `model`, its convex `collision` geometry and its `visual` geometry."""

    model: pin.Model
    collision: pin.GeometryModel
    visual: pin.GeometryModel


def load_urdf(file: str | Path) -> UrdfTree:
    """Read a URDF; its root link's frame is the model's universe frame.

    Collision meshes become their convex hulls. Meshes are found beside the file or in the folders around it
    (`package://`).

    Raises:
        InputError: There is no such file, it is no valid URDF, a mesh cannot be read, a joint type is not supported,
            or a link is drawn while nothing in the whole file can collide.
    """
    path = Path(file)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            "cannot read the URDF", file=path, expected="an existing URDF file", got=getattr(error, "strerror", None) or error
        ) from error
    _check(path, text)
    folders = [str(folder) for folder in (path.parent, path.parent.parent)]
    try:
        model = pin.buildModelFromXML(text)
        collision = pin.buildGeomFromUrdfString(model, text, pin.GeometryType.COLLISION, package_dirs=folders)
        visual = pin.buildGeomFromUrdfString(model, text, pin.GeometryType.VISUAL, package_dirs=folders)
    except (ValueError, RuntimeError) as error:
        raise InputError(f"not a valid URDF: {error}", file=path) from error
    for shape in collision.geometryObjects:
        if not isinstance(shape.geometry, _CONVEX):
            shape.geometry = load_convex(shape.meshPath, shape.meshScale)
    if len(visual.geometryObjects) > 0 and len(collision.geometryObjects) == 0:
        raise InputError("nothing in this URDF can collide", file=path, expected="<collision> elements", got="only <visual> ones")
    return UrdfTree(model, collision, visual)


def _check(path: Path, text: str) -> None:
    """Raise on what Pinocchio would accept with another meaning, or refuse without saying why."""
    from xml.etree import ElementTree

    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(f"not valid XML: {error}", file=path, line=error.position[0]) from error
    if root.tag != "robot":
        raise InputError("not a URDF", file=path, field=root.tag, expected="an element <robot>", got=f"<{root.tag}>")
    supported = ("revolute", "continuous", "prismatic", "fixed")
    for joint in root.iter("joint"):
        name, kind = joint.get("name", "?"), joint.get("type")
        if kind is not None and kind not in supported:
            raise InputError("this joint type is not supported", file=path, field=name, expected=", ".join(supported), got=kind)
        if joint.find("mimic") is not None:  # Pinocchio's parser would let it move on its own
            raise InputError("joints that mimic others are not supported", file=path, field=name, expected="no <mimic>")
