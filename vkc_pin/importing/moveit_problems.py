"""Reads planning problems of MoveIt: a scene of boxes, cylinders and spheres, and a request.

These are the messages moveit_msgs/PlanningScene and MotionPlanRequest as YAML files, as
MotionBenchMaker (Chamzas et al., RA-L 2022) writes them: `scene0001.yaml` and `request0001.yaml`.
Objects are in the frame of the world or of a link of the robot. The goal is one value for each of
some joints.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pinocchio as pin
import pydantic

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.world.files.documents import parse_document, read_yaml
from vkc_pin.world.scene.joint_state import JointStateSchema
from vkc_pin.world.scene.scene import Scene

_FIELDS = {"box": 3, "cylinder": 2, "sphere": 1}
"""Type of a primitive → number of its dimensions [m]."""
_ARENA = 10.0  # [m] half the edge of the square that a driving base may use
_REQUEST = re.compile(r"request(\w+)\.yaml")


class _Part(pydantic.BaseModel):
    """A part of a message; its other fields are not used."""

    model_config = pydantic.ConfigDict(extra="ignore", allow_inf_nan=False)


class _Primitive(_Part):
    type: Literal["box", "cylinder", "sphere"]
    dimensions: tuple[float, ...]


class _Pose(_Part):
    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float]  # x, y, z, w


class _Header(_Part):
    frame_id: str = ""


class _Object(_Part):
    id: str
    header: _Header = _Header()
    primitives: tuple[_Primitive, ...] = ()
    primitive_poses: tuple[_Pose, ...] = ()
    meshes: tuple[Any, ...] = ()
    planes: tuple[Any, ...] = ()


class _World(_Part):
    collision_objects: tuple[_Object, ...] = ()


class _Scene(_Part):
    world: _World = _World()


class _State(_Part):
    joint_state: JointStateSchema = JointStateSchema()


class _JointGoal(_Part):
    joint_name: str
    position: float


class _Goal(_Part):
    joint_constraints: tuple[_JointGoal, ...] = ()
    position_constraints: tuple[Any, ...] = ()
    orientation_constraints: tuple[Any, ...] = ()


class _Request(_Part):
    start_state: _State = _State()
    goal_constraints: tuple[_Goal, ...]


@dataclass(frozen=True, eq=False)
class Problem:
    """A scene at its start, and the goal: joint → value [rad] or [m]."""

    scene: Scene
    goal: Mapping[str, float]


def list_problems(folder: str | Path) -> dict[str, tuple[Path, Path]]:
    """Return name → scene and request file of each problem in a folder and its folders.

    Raises:
        InputError: There are none, or a request has no scene beside it.
    """
    found = dict[str, tuple[Path, Path]]()
    for request in sorted(Path(folder).rglob("request*.yaml")):
        match = _REQUEST.fullmatch(request.name)
        if match is None:
            continue
        scene = request.with_name(f"scene{match[1]}.yaml")
        if not scene.is_file():
            raise InputError(
                "there is no scene for this request", file=request, expected=scene.name
            )
        name = request.relative_to(folder).with_name(match[1]).as_posix()
        found[name] = (scene, request)
    if not found:
        expected = "files scene0001.yaml and request0001.yaml"
        raise InputError("there are no problems in this folder", file=folder, expected=expected)
    return found


def read_problem(
    scene: str | Path, request: str | Path, robot: str | Path, *, base: str = "fixed"
) -> Problem:
    """Return a problem for a robot.

    Args:
        scene: File of the planning scene.
        request: File of the request.
        robot: Name or robot.yaml file of the robot.
        base: Kind of its base: "fixed" or, with nothing on the floor, "omni".

    Raises:
        InputError: A file cannot be read, or has meshes, planes or a goal other than joint values.
    """
    world = parse_document(read_yaml(scene), _Scene).world
    asked = parse_document(read_yaml(request), _Request)
    document = {
        "name": f"{Path(scene).parent.name}_{Path(scene).stem}",
        "robot": {"name": str(robot), "base": base},
        "floor": False,
        "start": {"base": [0.0, 0.0, 0.0]},
        "arena": {"x": [-_ARENA, _ARENA], "y": [-_ARENA, _ARENA]},
    }
    empty = Scene.from_document(document, ".")
    values = asked.start_state.joint_state.positions
    arm = empty.robot.coordinates.names[3:]
    start = {name: values[name] for name in arm if name in values}
    # Objects may be in the frame of a link of the robot at its start.
    at_start = empty.with_start(arm=start)
    obstacles = list[dict[str, Any]]()
    for item in world.collision_objects:
        frame = _find_frame(at_start, item, scene)
        obstacles += _convert(item, frame, scene)
    placed = Scene.from_document({**document, "obstacles": obstacles}, ".").with_start(arm=start)
    return Problem(placed, _read_goal(asked, Path(request)))


def _find_frame(scene: Scene, item: _Object, file: str | Path) -> pin.SE3:
    """Return the placement of the frame of an object in the world."""
    name = item.header.frame_id
    model = scene.robot.model
    if name in ("", "world", "map"):
        return pin.SE3.Identity()
    names = [frame.name for frame in model.frames if frame.type == pin.FrameType.BODY]
    if name not in names:
        raise UnknownNameError("frame", name, names, file=file, field=item.id)
    data = model.createData()
    pin.framesForwardKinematics(model, data, scene.robot.coordinates.q(scene.start[None])[0])
    return data.oMf[model.getFrameId(name, pin.FrameType.BODY)]


def _convert(item: _Object, frame: pin.SE3, file: str | Path) -> list[dict[str, Any]]:
    """Return an object of a planning scene as obstacles of a scene file."""
    field = f"world.collision_objects: {item.id}"
    if item.meshes or item.planes:
        expected = "boxes, cylinders and spheres"
        raise InputError("shapes are not supported", file=file, field=field, expected=expected)
    if len(item.primitives) != len(item.primitive_poses):
        raise InputError(
            "wrong number",
            file=file,
            field=field,
            expected=f"{len(item.primitives)} poses",
            got=len(item.primitive_poses),
        )
    entries = list[dict[str, Any]]()
    for number, shape in enumerate(item.primitives):
        if len(shape.dimensions) != _FIELDS[shape.type]:
            raise InputError(
                "wrong number",
                file=file,
                field=field,
                expected=f"{_FIELDS[shape.type]} dimensions",
                got=len(shape.dimensions),
            )
        pose = item.primitive_poses[number]
        x, y, z, w = pose.orientation
        rotation = pin.Quaternion(w, x, y, z).normalized()
        placement = frame * pin.SE3(rotation, np.array(pose.position))
        entry: dict[str, Any] = {
            "name": item.id if number == 0 else f"{item.id}_{number}",
            "type": shape.type,
            "position": placement.translation.tolist(),
            "quaternion": pin.Quaternion(placement.rotation).coeffs().tolist(),
        }
        if shape.type == "box":
            entry["size"] = list(shape.dimensions)
        elif shape.type == "cylinder":
            # The height comes first, as shape_msgs/SolidPrimitive says.
            entry["length"], entry["radius"] = shape.dimensions
        else:
            (entry["radius"],) = shape.dimensions
        entries.append(entry)
    return entries


def _read_goal(request: _Request, file: Path) -> dict[str, float]:
    """Return the first goal of a request."""
    goal = request.goal_constraints[0] if request.goal_constraints else _Goal()
    has_other_goals = bool(goal.position_constraints or goal.orientation_constraints)
    if not goal.joint_constraints or has_other_goals:
        raise InputError(
            "no goal in joint space",
            file=file,
            field="goal_constraints",
            expected="joint_constraints alone",
        )
    return {each.joint_name: each.position for each in goal.joint_constraints}
