"""Writes scenes for imported robots and objects."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from vkc_pin.errors import InputError
from vkc_pin.importing.proposals.proposal import Proposals
from vkc_pin.importing.targets import format_comment, get_origin_marker
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.writing import write_atomically
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.robot_file import list_robots
from vkc_pin.world.scene.scene import START_CLEARANCE, Scene

_ROOM = 3.0  # [m] of floor around the base of a robot
_DISTANCES = np.arange(1.2, 6.0, 0.2)  # [m] of the start from the object's grasp
_MARGIN = 2.0  # [m] of floor around start and object
HORIZONTAL = 0.5
"""Horizontal part of a grasp's approach, a unit vector, up to which it is one from above."""


def locate_robot(robot: str | Path | Robot) -> str:
    """Return a robot's name or absolute path, as a scene in any folder can refer to it."""
    if isinstance(robot, Robot):
        described = robot.urdf.parent / "robot.yaml"
        file = described if described.is_file() else robot.urdf
        is_bundled = list_robots().get(robot.name) == file
        return robot.name if is_bundled else str(file.resolve())
    by_path = isinstance(robot, Path) or robot.endswith((".urdf", ".yaml", ".yml")) or "/" in robot
    return str(Path(robot).resolve()) if by_path else str(robot)


def refer_to_robot(robot: str | Path | Robot, folder: Path) -> str:
    """Return a robot as a scene that is written into a folder refers to it.

    Names and absolute paths stay; other paths are relative to the folder, so that both can be moved
    together.
    """
    place = locate_robot(robot)
    is_given = not isinstance(robot, Robot) and Path(robot).is_absolute()
    if is_given or not Path(place).is_absolute():
        return place
    relative = Path(os.path.relpath(place, os.path.realpath(folder))).as_posix()
    return relative if "/" in relative else f"./{relative}"


def write_scene(file: Path, source: Path, document: Mapping[str, Any], command: str) -> None:
    """Write a scene file that a command made of a source."""
    head = format_comment(f"Made of {source.name} {get_origin_marker(command)}.")
    body = yaml.safe_dump(document, sort_keys=False, width=130, default_flow_style=None)
    write_atomically(file, (head + body).encode())


def make_robot_scene(name: str, robot: str, base: str) -> dict[str, Any]:
    """Return a scene with a robot alone.

    Args:
        name: Name of the scene.
        robot: File of the robot, relative to the scene.
        base: Type of its base.
    """
    arena = {"x": [-_ROOM, _ROOM], "y": [-_ROOM, _ROOM]}
    start = {"base": [0.0, 0.0, 0.0], "arm": "home"}
    return {"name": name, "robot": {"name": robot, "base": base}, "start": start, "arena": arena}


def make_object_scene(
    file: str, proposals: Proposals, size: Floats, robot: str, folder: Path
) -> dict[str, Any] | None:
    """Return a scene with an object, and a robot that faces it with clearance; None without room.

    Args:
        file: Description of the object, relative to the scene.
        proposals: Its attachments; the robot starts in front of the best one.
        size: Size of the object [m], shape (3,).
        robot: The robot, see `locate_robot`.
        folder: Folder of the scene.
    """
    place, back = _find_start_line(proposals, size)
    yaw = float(np.arctan2(-back[1], -back[0]))
    name = Path(file).stem
    for distance in _DISTANCES:
        x, y = (place + distance * back).tolist()
        corners = np.array([[x, y], -0.5 * size[:2], 0.5 * size[:2]])
        low = corners.min(axis=0) - _MARGIN
        high = corners.max(axis=0) + _MARGIN
        document = {
            "name": name,
            "robot": robot,
            "start": {"base": [round(x, 3), round(y, 3), round(yaw, 4)], "arm": "home"},
            "arena": {
                "x": round_interval(low[0], high[0]),
                "y": round_interval(low[1], high[1]),
            },
            "objects": [{"name": name, "type": file, "position": [0.0, 0.0, 0.0]}],
        }
        with warnings.catch_warnings():
            # They are repeated when the scene is loaded.
            warnings.simplefilter("ignore")
            try:
                scene = Scene.from_document(document, folder)
            except InputError:
                # The start collides.
                continue
        if scene.start_clearance(reach=1.0) >= START_CLEARANCE:
            return document
    return None


def _find_start_line(proposals: Proposals, size: Floats) -> tuple[Floats, Floats]:
    """Return a point and a direction, shape (2,) each, of the line of a robot that faces an object.

    The line begins below the best grasp, and leads away from it against the approach. For a grasp
    from above, it leads away from the object's centre. Without a grasp, it begins at the front.
    """
    back = np.array([-1.0, 0.0])
    if not proposals.found:
        return -0.5 * np.array([size[0], 0.0]), back
    attachment = proposals.found[0].attachment
    item = proposals.object
    state = np.clip(np.zeros(len(item.lower)), item.lower, item.upper)
    tool = item.link_placement(attachment.link, state) * attachment.placement
    place = tool.translation[:2]
    direction = tool.rotation[:2, 2]
    length = float(np.linalg.norm(direction))
    if length > HORIZONTAL:
        back = -direction / length
    elif np.linalg.norm(place) > 0.0:
        back = place / np.linalg.norm(place)
    return place, back


def round_interval(low: float, high: float) -> list[float]:
    """Return both ends of an interval of a scene's arena, rounded to millimetres [m]."""
    return [round(float(low), 3), round(float(high), 3)]
