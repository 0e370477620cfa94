"""Builds a scene from its description, and says where the description is wrong."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin import scene_schema as schema
from vkc_pin.assembly import clean
from vkc_pin.documents import Document, check
from vkc_pin.geometry import PlacedObject, copy_shape, within_limits
from vkc_pin.hold import holds_of
from vkc_pin.in_hand import check_holds
from vkc_pin.object_file import load_object
from vkc_pin.scene import FLOOR, Scene
from vkc_pin.starts import StartRegion, start_limits
from vkc_pin.urdf import load_urdf

if TYPE_CHECKING:
    from vkc_pin.robot import Robot

__all__ = ["build_scene"]

_FLOOR_THICKNESS = 0.1
_FLOOR_BORDER = 2.0  # the floor reaches this far beyond the arena [m]: an arm may hang over its edge


def build_scene(document: Document, folder: Path) -> Scene:
    """Build the scene that `document` describes; relative paths in it start from `folder`.

    Raises:
        InputError: The description is wrong; `UnknownNameError` where it names something that does not exist.
    """
    description = check(document, schema.SceneSchema)
    robot = _robot(document, description.robot, folder)
    _unique_names(document, description)
    objects = {item.name: _object(document, ("objects", index), item, folder) for index, item in enumerate(description.objects)}
    arena = (*description.arena.x, *description.arena.y)
    obstacles, visual, labels = pin.GeometryModel(), pin.GeometryModel(), []
    for index, item in enumerate(description.obstacles):
        drawn, shapes = _obstacle(document, ("obstacles", index), item, folder)
        for shape in drawn:
            visual.addGeometryObject(shape)
        for shape in shapes:
            obstacles.addGeometryObject(shape)
            labels.append(item.name)
    if description.floor:
        obstacles.addGeometryObject(_floor(arena))
        labels.append(FLOOR)
    region = description.start_region
    _check_places(document, description, arena)
    plain: dict[str, Any] = description.model_dump(mode="json", exclude_none=True)
    held = description.start.held
    _held(document, held, objects)
    name = description.name or (document.file.stem if document.file else "scene")
    scene = Scene(
        name=name,
        file=document.file,
        folder=folder,
        robot=robot,
        start=_start(document, description.start, robot),
        objects=MappingProxyType(objects),
        obstacles=obstacles,
        obstacle_labels=tuple(labels),
        obstacle_names=tuple(item.name for item in description.obstacles),
        obstacle_visual=visual,
        floor=description.floor,
        arena=arena,
        start_region=StartRegion(region.x, region.y, region.yaw) if region else None,
        held=MappingProxyType({name: item.attachment for name, item in held.items()}),
        held_by=MappingProxyType({name: item.by for name, item in held.items() if item.by}),
        held_at=MappingProxyType({name: item.at for name, item in held.items() if item.at}),
        document={**plain, "name": name},
    )
    return scene.with_held_objects_in_the_hand()


def _robot(document: Document, item: schema.RobotSchema, folder: Path) -> Robot:
    from vkc_pin.robot_file import load_robot

    by_path = item.name.endswith((".urdf", ".yaml", ".yml")) or "/" in item.name
    short = isinstance(document.value(("robot",)), str)  # robot: husky_ur5e
    with document.at(("robot",) if short else ("robot", "name")):
        return load_robot(folder / item.name if by_path else item.name, base=item.base, tool_frame=item.tool_frame)


def _unique_names(document: Document, description: schema.SceneSchema) -> None:
    taken = {FLOOR: "the floor"}
    for group, items in (("obstacles", description.obstacles), ("objects", description.objects)):
        for index, item in enumerate(items):
            path = (group, index, "name")
            if item.name in taken:
                raise document.error(path, "this name is taken", expected="a new name", got=f"{item.name}, as {taken[item.name]}")
            line = document.line(path)
            taken[item.name] = f"{group}[{index}]" + (f" in line {line}" if line else "")


def _check_places(document: Document, description: schema.SceneSchema, arena: tuple[float, float, float, float]) -> None:
    for axis, low, high, value in (("x", *arena[:2], description.start.base[0]), ("y", *arena[2:], description.start.base[1])):
        if not low <= value <= high:
            entry = ("start", "base", 0 if axis == "x" else 1)
            raise document.error(entry, "outside the arena", expected=f"{axis} from {low:g} to {high:g}", got=value)
        interval = getattr(description.start_region, axis, None)
        if interval is not None and not low <= interval[0] <= interval[1] <= high:
            path = ("start_region", axis)
            raise document.error(path, "outside the arena", expected=f"{axis} from {low:g} to {high:g}", got=list(interval))


def _start(document: Document, item: schema.StartSchema, robot: Robot) -> NDArray[np.float64]:
    arm = robot.home if item.arm is None else np.array(item.arm)
    names = robot.coordinates.names[3:]
    if len(arm) != len(names):
        expected = f"{len(names)} values: {', '.join(names)}"
        raise document.error(("start", "arm"), "wrong number of arm joints", expected=expected, got=len(arm))
    start = np.concatenate([item.base, arm])
    lower, upper = start_limits(robot)
    for index, name in enumerate(robot.coordinates.names):
        path = ("start", "base", index) if index < 3 else ("start", "arm", index - 3)
        with document.at(path):
            start[index] = within_limits(start[index], lower[index], upper[index], name)
    return start


def _held(document: Document, held: Mapping[str, schema.HeldSchema], objects: Mapping[str, PlacedObject]) -> None:
    """Check what the robot is said to hold."""
    for name, item in held.items():
        path = ("start", "held", name)
        if name not in objects:
            raise document.unknown(path, "object", name, objects)
        with document.at(path):
            check_holds(objects, {name: item.attachment}, {}, {} if item.at is None else {name: item.at})
            if item.by is not None:
                owner = item.by.partition(".")[0]
                both = {owner: held[owner].attachment} if owner in held else {}
                check_holds(objects, {name: item.attachment, **both}, {name: item.by}, {})
    with document.at(("start", "held")):
        holds_of({n: item.attachment for n, item in held.items()}, {n: item.by for n, item in held.items() if item.by})


def _pose(item: schema.PoseSchema) -> pin.SE3:
    roll, pitch, yaw = item.rpy or (0.0, 0.0, item.yaw or 0.0)
    return clean(pin.SE3(pin.rpy.rpyToMatrix(roll, pitch, yaw), np.array(item.position)))


def _file(document: Document, path: tuple[str | int, ...], folder: Path, name: str) -> Path:
    file = folder / name
    if not file.is_file():
        raise document.error(path, "there is no such file", expected=f"a file in {folder}", got=name)
    return file


def _object(document: Document, path: tuple[str | int, ...], item: schema.PlacedObjectSchema, folder: Path) -> PlacedObject:
    by_path = item.type.endswith((".yaml", ".yml")) or "/" in item.type
    with document.at((*path, "type")):
        loaded = load_object(_file(document, (*path, "type"), folder, item.type) if by_path else item.type)
    neutral = np.clip(0.0, loaded.lower, loaded.upper)
    placed = PlacedObject(item.name, loaded, _pose(item), neutral)
    for joint, value in item.state.items():
        with document.at((*path, "state", joint)):
            placed = placed.with_state({joint: value})
    return placed


def _obstacle(
    document: Document, path: tuple[str | int, ...], item: schema.ObstacleSchema, folder: Path
) -> tuple[list[pin.GeometryObject], list[pin.GeometryObject]]:
    """Return what to draw of an obstacle and what collides, in the world frame."""
    pose = _pose(item)
    if isinstance(item, schema.UrdfSchema):
        with document.at((*path, "file")):
            tree = load_urdf(_file(document, (*path, "file"), folder, item.file))
        data = tree.model.createData()
        pin.forwardKinematics(tree.model, data, pin.neutral(tree.model))
        both = []
        for geometry in (tree.visual, tree.collision):
            shapes = geometry.geometryObjects
            names = [item.name] if len(shapes) == 1 else [f"{item.name}_{k}" for k in range(len(shapes))]
            both.append(
                [
                    copy_shape(shape, name, pose * data.oMi[shape.parentJoint] * shape.placement)
                    for shape, name in zip(shapes, names, strict=True)
                ]
            )
            for shape in both[-1] if item.colour else ():
                shape.meshColor, shape.overrideMaterial = np.array(item.colour), True
        return both[0], both[1]
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
            from vkc_pin.meshes import load_convex

            file, scale = _file(document, (*path, "file"), folder, item.file), np.array(item.scale)
            with document.at((*path, "file")):
                solid = load_convex(file, scale)
            drawn_as = str(file)
    drawn = _shape(item.name, pose, solid, item.colour)
    drawn.meshPath, drawn.meshScale = drawn_as, scale
    return [drawn], [_shape(item.name, pose, solid, item.colour)]


def _shape(
    name: str, pose: pin.SE3, shape: coal.CollisionGeometry, colour: tuple[float, float, float, float]
) -> pin.GeometryObject:
    made = pin.GeometryObject(name, 0, 0, pose, shape)
    made.meshColor, made.overrideMaterial = np.array(colour), True
    return made


def _floor(arena: tuple[float, float, float, float]) -> pin.GeometryObject:
    """Return the floor: a box, not a half space, which has no size to draw or to bound."""
    x_min, x_max, y_min, y_max = arena
    size = (x_max - x_min + 2 * _FLOOR_BORDER, y_max - y_min + 2 * _FLOOR_BORDER, _FLOOR_THICKNESS)
    centre = np.array([(x_min + x_max) / 2, (y_min + y_max) / 2, -_FLOOR_THICKNESS / 2])
    return _shape(FLOOR, pin.SE3(np.eye(3), centre), coal.Box(*size), (0.80, 0.78, 0.74, 1.0))
