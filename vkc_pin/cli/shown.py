"""Finds what `vkc-pin view` shows: a plan, a scene, a robot or an object."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.importing.scenes import make_robot_scene
from vkc_pin.world.files.documents import read_yaml
from vkc_pin.world.files.resources import list_resources
from vkc_pin.world.models.object_file import load_object
from vkc_pin.world.models.robot_file import find_robot, list_robots, load_robot
from vkc_pin.world.models.shapes import compute_world_box
from vkc_pin.world.scene.scene import Scene, load_scene

if TYPE_CHECKING:
    from vkc_pin.planning.plan import Plan


# stands beside an object, for scale
_ROBOT = "husky_ur5e"
# [m] between the centre of its base and the object
_BESIDE = 1.5


def load_shown(what: str) -> tuple[Plan | Scene, dict[str, pin.SE3]]:
    """Load a plan (.npz), scene, robot or object by its name, file or folder.

    Robots and objects become scenes.

    Returns:
        The plan or scene, and frames to draw in it: the tool frame of a robot.
    """
    if what.endswith(".npz"):
        from vkc_pin.planning.plan import Plan

        return Plan.load(what), {}
    path = find_description(Path(what)) if "/" in what or Path(what).exists() else None
    if path is None:
        return _load_by_name(what)
    if path.suffix.lower() == ".urdf" or path.name == "robot.yaml":
        return _show_robot(path)
    data = read_yaml(path).data
    if isinstance(data, dict) and "urdf" in data and "robot" not in data:
        return _show_object(path), {}
    return load_scene(path), {}


def find_description(path: Path) -> Path:
    """Return the file that describes the content of a folder."""
    if not path.is_dir():
        return path
    for name in ("robot.yaml", "scene.yaml", f"{path.resolve().name}.yaml"):
        if (path / name).is_file():
            return path / name
    expected = f"robot.yaml, scene.yaml or {path.resolve().name}.yaml in it"
    raise InputError("the folder has nothing to show", file=path, expected=expected)


def _load_by_name(name: str) -> tuple[Scene, dict[str, pin.SE3]]:
    """Load a scene, robot or object of the package."""
    scenes = list_resources("scenes", "*.yaml")
    objects = list_resources("scenes", "objects/*.yaml")
    if name in scenes or name.endswith((".yaml", ".yml")):
        return load_scene(name), {}
    robots = list_robots()
    if name in robots:
        return _show_robot(find_robot(name))
    if name in objects:
        return _show_object(objects[name]), {}
    raise UnknownNameError("scene, object or robot", name, [*scenes, *objects, *robots])


def _show_robot(file: Path) -> tuple[Scene, dict[str, pin.SE3]]:
    """Return a scene of a robot alone, and its tool frame."""
    robot = load_robot(file)
    document = make_robot_scene(robot.name, str(file.resolve()), "omni")
    scene = Scene.from_document(document, file.parent)
    data = robot.model.createData()
    q = robot.coordinates.q(np.concatenate([np.zeros(3), robot.home]))
    pin.framesForwardKinematics(robot.model, data, q)
    frame = robot.model.getFrameId(robot.tool_frame)
    return scene, {robot.tool_frame: data.oMf[frame]}


def _show_object(file: Path) -> Scene:
    """Return a scene of an object at the origin, with a robot in front of it."""
    item = load_object(file)
    data = item.model.createData()
    q = item.coordinates.q(np.clip(0.0, item.lower, item.upper))
    pin.forwardKinematics(item.model, data, q)
    boxes = [
        compute_world_box(shape.geometry, data.oMi[shape.parentJoint] * shape.placement)
        for shape in item.collision.geometryObjects
    ]
    front = min((float(low[0]) for low, _ in boxes), default=0.0)
    size = max((float(np.abs(box).max()) for box in boxes), default=0.0)
    reach = size + 2.0 * _BESIDE
    placed = {"name": item.name, "type": str(file.resolve()), "position": [0.0, 0.0, 0.0]}
    document: dict[str, Any] = {
        "name": item.name,
        "robot": _ROBOT,
        "start": {"base": [front - _BESIDE, 0.0, 0.0], "arm": "home"},
        "arena": {"x": [-reach, reach], "y": [-reach, reach]},
        "objects": [placed],
    }
    return Scene.from_document(document, file.parent)
