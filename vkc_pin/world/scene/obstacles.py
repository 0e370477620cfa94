"""Builds the collision and visual shapes of fixed obstacles, including the floor."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.world.models.shapes import copy_shape
from vkc_pin.world.scene.measured_points import make_cloud_shapes

if TYPE_CHECKING:
    from vkc_pin.world.scene import scene_schema as schema


FLOOR = "floor"
"""Name of the floor among a scene's obstacles."""
_FLOOR_THICKNESS = 0.1  # [m]
_FLOOR_BORDER = 2.0  # [m] beyond the arena: an arm may reach over its edge
_FLOOR_COLOUR = (0.80, 0.78, 0.74, 1.0)


def make_obstacle_shapes(
    item: schema.ObstacleSchema, pose: pin.SE3, folder: Path
) -> tuple[list[pin.GeometryObject], list[pin.GeometryObject]]:
    """Return the visual and the collision shapes of an obstacle, in the world frame."""
    from vkc_pin.world.scene import scene_schema as schema

    if isinstance(item, schema.UrdfSchema):
        return _make_urdf_shapes(item, pose, folder / item.file)
    if isinstance(item, schema.PointsSchema):
        return make_cloud_shapes(item, pose)
    mesh_path = ""
    mesh_scale = np.ones(3)
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

            mesh_path = str(folder / item.file)
            mesh_scale = np.array(item.scale)
            solid = load_convex(mesh_path, mesh_scale, about=item.name)
    visual = _make_shape(item.name, pose, solid, item.colour)
    # Viewers draw the file.
    visual.meshPath = mesh_path
    visual.meshScale = mesh_scale
    collision = _make_shape(item.name, pose, solid, item.colour)
    return [visual], [collision]


def move_obstacle_shape(
    item: schema.ObstacleSchema, shape: pin.GeometryObject, before: pin.SE3, after: pin.SE3
) -> pin.GeometryObject:
    """Return a copy of an obstacle's shape, moved with the obstacle.

    Args:
        item: Description of the obstacle.
        shape: One of its shapes, in the world frame.
        before: Placement of the obstacle with which the shape was made.
        after: New placement of the obstacle.
    """
    placement = after
    if item.type in ("urdf", "points"):
        # Links of a URDF and blocks of points have placements of their own in the obstacle.
        placement = after * before.actInv(shape.placement)
    return copy_shape(shape, shape.name, placement)


def make_floor_shape(arena: tuple[float, float, float, float]) -> pin.GeometryObject:
    """Return the floor of an arena as a box, which, unlike a half space, can be drawn and bounded.

    Args:
        arena: (x_min, x_max, y_min, y_max) [m].
    """
    x_min, x_max, y_min, y_max = arena
    length = x_max - x_min + 2 * _FLOOR_BORDER
    width = y_max - y_min + 2 * _FLOOR_BORDER
    center = np.array([(x_min + x_max) / 2, (y_min + y_max) / 2, -_FLOOR_THICKNESS / 2])
    solid = coal.Box(length, width, _FLOOR_THICKNESS)
    return _make_shape(FLOOR, pin.SE3(np.eye(3), center), solid, _FLOOR_COLOUR)


def _make_urdf_shapes(
    item: schema.UrdfSchema, pose: pin.SE3, file: Path
) -> tuple[list[pin.GeometryObject], list[pin.GeometryObject]]:
    """Return the visual and the collision shapes of a URDF with all joints at zero."""
    from vkc_pin.world.files.urdf import load_urdf

    model, collision, visual = load_urdf(file)
    data = model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model))

    def copy_shapes(geometry: pin.GeometryModel) -> list[pin.GeometryObject]:
        copies = []
        for k, shape in enumerate(geometry.geometryObjects):
            name = item.name if len(geometry.geometryObjects) == 1 else f"{item.name}_{k}"
            placement = pose * data.oMi[shape.parentJoint] * shape.placement
            copy = copy_shape(shape, name, placement)
            if item.colour:
                copy.meshColor = np.array(item.colour)
                copy.overrideMaterial = True
            copies.append(copy)
        return copies

    return copy_shapes(visual), copy_shapes(collision)


def _make_shape(
    name: str,
    pose: pin.SE3,
    shape: coal.CollisionGeometry,
    colour: tuple[float, float, float, float],
) -> pin.GeometryObject:
    created = pin.GeometryObject(name, 0, 0, pose, shape)
    created.meshColor = np.array(colour)
    created.overrideMaterial = True
    return created
