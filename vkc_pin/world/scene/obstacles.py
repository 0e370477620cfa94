"""Builds the collision and visual shapes of fixed obstacles, including the floor."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.world.models.shapes import copy_shape

if TYPE_CHECKING:
    from vkc_pin.world.scene import scene_schema as schema


FLOOR = "floor"
"""Name of the floor among a scene's obstacles."""
_FLOOR_THICKNESS = 0.1
_FLOOR_BORDER = 2.0  # [m] beyond the arena: an arm may reach over its edge


def make_obstacle_shapes(
    item: schema.ObstacleSchema, pose: pin.SE3, folder: Path
) -> tuple[list[pin.GeometryObject], list[pin.GeometryObject]]:
    """Return the visual and the collision shapes of an obstacle, in the world frame."""
    from vkc_pin.world.scene import scene_schema as schema

    if isinstance(item, schema.UrdfSchema):
        return _make_urdf_shapes(item, pose, folder / item.file)
    drawn_as, scale = "", np.ones(3)
    solid: coal.CollisionGeometry
    match item:
        case schema.BoxSchema():
            solid = coal.Box(*item.size)
        case schema.SphereSchema():
            solid = coal.Sphere(item.radius)
        case schema.CylinderSchema():
            solid = coal.Cylinder(item.radius, item.length)
        case schema.CapsuleSchema():
            solid = coal.Capsule(item.radius, item.length)
        case schema.MeshSchema():
            from vkc_pin.world.files.meshes import load_convex

            drawn_as, scale = str(folder / item.file), np.array(item.scale)
            solid = load_convex(drawn_as, scale, about=item.name)
    drawn = _make_shape(item.name, pose, solid, item.colour)
    drawn.meshPath, drawn.meshScale = drawn_as, scale
    return [drawn], [_make_shape(item.name, pose, solid, item.colour)]


def make_floor_shape(arena: tuple[float, float, float, float]) -> pin.GeometryObject:
    """Return the floor of an arena as a box, which, unlike a half space, can be drawn and bounded.

    Args:
        arena: (x_min, x_max, y_min, y_max) [m].
    """
    x_min, x_max, y_min, y_max = arena
    size = (x_max - x_min + 2 * _FLOOR_BORDER, y_max - y_min + 2 * _FLOOR_BORDER, _FLOOR_THICKNESS)
    centre = np.array([(x_min + x_max) / 2, (y_min + y_max) / 2, -_FLOOR_THICKNESS / 2])
    return _make_shape(FLOOR, pin.SE3(np.eye(3), centre), coal.Box(*size), (0.80, 0.78, 0.74, 1.0))


def _make_urdf_shapes(
    item: schema.UrdfSchema, pose: pin.SE3, file: Path
) -> tuple[list[pin.GeometryObject], list[pin.GeometryObject]]:
    """Return the visual and the collision shapes of a URDF with all joints at zero."""
    from vkc_pin.world.files.urdf import load_urdf

    model, collision, visual = load_urdf(file)
    data = model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model))
    both = []
    for geometry in (visual, collision):
        shapes = geometry.geometryObjects
        names = (
            [item.name] if len(shapes) == 1 else [f"{item.name}_{k}" for k in range(len(shapes))]
        )
        both.append(
            [
                copy_shape(shape, name, pose * data.oMi[shape.parentJoint] * shape.placement)
                for shape, name in zip(shapes, names, strict=True)
            ]
        )
        for shape in both[-1] if item.colour else ():
            shape.meshColor, shape.overrideMaterial = np.array(item.colour), True
    return both[0], both[1]


def _make_shape(
    name: str,
    pose: pin.SE3,
    shape: coal.CollisionGeometry,
    colour: tuple[float, float, float, float],
) -> pin.GeometryObject:
    created = pin.GeometryObject(name, 0, 0, pose, shape)
    created.meshColor, created.overrideMaterial = np.array(colour), True
    return created
