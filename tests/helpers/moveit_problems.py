"""Writes a problem of MoveIt: an arm beside some shapes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

ROBOT = "husky_ur5e"
JOINTS = [f"{name}_joint" for name in ("shoulder_pan", "shoulder_lift", "elbow")]
GOAL = dict(zip(JOINTS, (0.5, -1.2, -1.4), strict=True))
POSE = {"position": [1.0, 0.2, 0.9], "orientation": [0.0, 0.0, 1.0, 0.0]}


def make_scene() -> dict[str, Any]:
    shelf = {
        "id": "shelf",
        "primitives": [
            {"type": "box", "dimensions": [0.1, 0.2, 0.3]},
            {"type": "cylinder", "dimensions": [0.5, 0.04]},
            {"type": "sphere", "dimensions": [0.06]},
        ],
        "primitive_poses": [POSE] * 3,
    }
    return {"name": "", "world": {"collision_objects": [shelf]}}


def make_request() -> dict[str, Any]:
    goal = [{"joint_name": name, "position": GOAL[name]} for name in JOINTS]
    return {
        "start_state": {
            "joint_state": {"name": [*JOINTS, "wheel"], "position": [0.3, -1.0, -1.5, 2.0]}
        },
        "goal_constraints": [{"joint_constraints": goal}],
    }


def write(folder: Path, scene: dict[str, Any], request: dict[str, Any]) -> tuple[Path, Path]:
    files = folder / "scene0001.yaml", folder / "request0001.yaml"
    for file, data in zip(files, (scene, request), strict=True):
        file.write_text(yaml.safe_dump(data), encoding="utf-8")
    return files
