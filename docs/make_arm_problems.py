"""Poses problems to another arm in MoveIt's scenes: `make_arm_problems.py FOLDER ROBOT OTHER OUT`.

FOLDER has problems as `vkc_pin.importing.moveit_problems` reads them, for ROBOT. Problems in the
same scenes for the robot OTHER are written to the new folder OUT, in the same format and under the
same names. The obstacles are moved so that the first turning joint of the other arm stands where
that of the first arm did. The goal is a random free configuration with the tool among the
obstacles; the start is a random free one with the tool outside; the straight line between both is
blocked. Scenes where that is not found are left out, and named.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import yaml

import vkc_pin as vkc
from vkc_pin.importing.moveit_problems import list_problems, read_problem
from vkc_pin.planning.initialization.keyframes import find_free_configurations
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.world.models.shapes import compute_world_box
from vkc_pin.world.scene.hold import compute_tool_placement
from vkc_pin.world.task.compiler import compile_task

_OPTIONS = vkc.Options(dist_safe=0.005, self_distance=0.005)
_SAMPLES = 20_000
_RESOLUTION = 0.05  # [rad] between configurations of a straight line


def main(folder: str, robot: str, other: str, out: str) -> None:
    """Write the problems for the robot `other`."""
    rng = np.random.default_rng(0)
    for name, files in list_problems(folder).items():
        scene = replace_robot(read_problem(*files, robot).scene, other)
        found = find_problem(scene, rng)
        if found is None:
            print(f"{name}: no free configurations")
            continue
        documents = write_scene(scene), write_request(scene, *found)
        for file, document in zip(files, documents, strict=True):
            written = Path(out) / file.relative_to(folder)
            written.parent.mkdir(parents=True, exist_ok=True)
            written.write_text(yaml.safe_dump(document), encoding="utf-8")


def replace_robot(scene: vkc.Scene, robot: str) -> vkc.Scene:
    """Return the scene around another robot, whose first turning joint is where the other's was."""
    new = scene.with_robot(robot, base="fixed")
    offset = find_shoulder(new) - find_shoulder(scene)
    obstacles = [
        {**each, "position": (np.array(each["position"]) + offset).tolist()}
        for each in new.document["obstacles"]
    ]
    return vkc.Scene.from_document({**new.document, "obstacles": obstacles}, new.folder)


def find_problem(scene: vkc.Scene, rng: np.random.Generator) -> tuple[Floats, Floats] | None:
    """Return arm joints at start and goal, with a blocked straight line between them."""
    robot = scene.robot
    task = compile_task(scene, [vkc.Configure({robot.coordinates.names[3]: 0.0})], _OPTIONS)
    problem = TrajectoryProblem(scene, task, _OPTIONS)
    lower, upper = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi)
    z = np.tile(scene.start, (_SAMPLES, 1))
    z[:, 3:] = rng.uniform(lower[3:], upper[3:], z[:, 3:].shape)
    is_inside = is_among_obstacles(scene, z)
    goals, starts = z[is_inside], z[~is_inside][: is_inside.sum()]
    goals, starts = (each[find_free_configurations(problem, each, 1)] for each in (goals, starts))
    for start, goal in zip(starts, goals, strict=False):
        count = int(np.abs(goal - start).max() / _RESOLUTION) + 2
        line = np.linspace(start, goal, count)
        if not find_free_configurations(problem, line, 1).all():
            return start[3:], goal[3:]
    return None


def is_among_obstacles(scene: vkc.Scene, z: Floats) -> Bools:
    """Return for each configuration, shape (B, n), whether the tool is in their bounding box."""
    points = np.array([compute_tool_placement(scene.robot, row).translation for row in z])
    boxes = [compute_world_box(shape.geometry, shape.placement) for shape in scene.obstacles]
    low = np.min([box[0] for box in boxes], axis=0)
    high = np.max([box[1] for box in boxes], axis=0)
    inside = (points >= low) & (points <= high)
    return np.asarray(inside.all(axis=1))


def find_shoulder(scene: vkc.Scene) -> Floats:
    """Return the position of the first turning joint of the arm in the world frame [m]."""
    model = scene.robot.model
    data = model.createData()
    pin.forwardKinematics(model, data, scene.robot.coordinates.q(scene.start[None])[0])
    joints = (model.getJointId(name) for name in scene.robot.coordinates.names[3:])
    turning = next(joint for joint in joints if "JointModelR" in model.joints[joint].shortname())
    return data.oMi[turning].translation.copy()


def write_scene(scene: vkc.Scene) -> dict[str, Any]:
    """Return the obstacles of a scene as a planning scene of MoveIt."""
    objects = []
    for each in scene.document["obstacles"]:
        dimensions = each.get("size") or [each[key] for key in ("length", "radius") if key in each]
        pose = {"position": each["position"], "orientation": each["quaternion"]}
        primitive = {"type": each["type"], "dimensions": dimensions}
        objects.append({"id": each["name"], "primitives": [primitive], "primitive_poses": [pose]})
    return {"name": scene.name, "world": {"collision_objects": objects}}


def write_request(scene: vkc.Scene, start: Floats, goal: Floats) -> dict[str, Any]:
    """Return start and goal, arm joints, as a request of MoveIt."""
    names = list(scene.robot.coordinates.names[3:])
    goals = [
        {"joint_name": name, "position": value}
        for name, value in zip(names, goal.tolist(), strict=True)
    ]
    state = {"joint_state": {"name": names, "position": start.tolist()}}
    return {"start_state": state, "goal_constraints": [{"joint_constraints": goals}]}


if __name__ == "__main__":
    main(*sys.argv[1:])
