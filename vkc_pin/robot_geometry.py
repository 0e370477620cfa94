"""Puts the shapes of a robot's URDF on the joints of its model."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.assembly import clean
from vkc_pin.errors import InputError
from vkc_pin.robot_files import RobotFile, Shape

__all__ = ["collision_geometry", "visual_geometry"]

_DETAIL = 0.0015  # of displayed meshes, [m]
_GREY = (0.6, 0.6, 0.62, 1.0)


def collision_geometry(model: pin.Model, file: RobotFile) -> pin.GeometryModel:
    """Return the collision shapes of `file` on the joints of `model`, named `<link>_<k>`, meshes as their convex hulls.

    Raises:
        InputError: A shape is not understood, a mesh cannot be read or is flat, or there is no shape.
    """
    from vkc_pin.meshes import load_convex

    geometry = pin.GeometryModel()
    for shape in file.shapes("collision"):
        convex = _primitive(shape) if shape.file is None else load_convex(shape.file, shape.size)
        _add(geometry, model, shape, shape.name, convex, _GREY)
    if len(geometry.geometryObjects) == 0:
        raise InputError("nothing of this robot can collide", file=file.path, expected="<collision> elements", got="none")
    return geometry


def visual_geometry(model: pin.Model, file: RobotFile) -> pin.GeometryModel:
    """Return what `file` looks like on the joints of `model`: one shape per colour, light enough for a web page.

    The shapes hold triangles (`coal.BVHModelOBBRSS`) and `meshColor`; `meshPath` is empty, so that viewers draw what is
    here and load no file themselves.

    Raises:
        InputError: A shape is not understood, or a mesh cannot be read.
    """
    from vkc_pin.meshes import load_parts, to_bvh

    geometry = pin.GeometryModel()
    for shape in file.shapes("visual"):
        if shape.file is None:
            _add(geometry, model, shape, shape.name, _primitive(shape), shape.colour or _GREY)
            continue
        parts = load_parts(shape.file, shape.size, detail=_DETAIL)
        for k, part in enumerate(parts):
            name = shape.name if len(parts) == 1 else f"{shape.name}_{k}"
            _add(geometry, model, shape, name, to_bvh(part), shape.colour or part.colour or _GREY)
    return geometry


def _add(
    geometry: pin.GeometryModel,
    model: pin.Model,
    shape: Shape,
    name: str,
    solid: coal.CollisionGeometry,
    colour: tuple[float, ...],
) -> None:
    frame = model.getFrameId(shape.link, pin.FrameType.BODY)
    parent = model.frames[frame]
    added = pin.GeometryObject(name, parent.parentJoint, frame, clean(parent.placement * shape.placement), solid)
    added.meshColor = np.array(colour)
    geometry.addGeometryObject(added)


def _primitive(shape: Shape) -> coal.CollisionGeometry:
    kinds = {"box": coal.Box, "sphere": coal.Sphere, "cylinder": coal.Cylinder, "capsule": coal.Capsule}
    return kinds[shape.kind](*shape.size)
