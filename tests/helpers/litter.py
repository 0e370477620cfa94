"""Makes a scene with litter on the floor, a bin, and optional obstacles."""

from __future__ import annotations

from typing import Any

from vkc_pin.world.files.resources import find_resource_folder
from vkc_pin.world.scene.scene import Scene

LITTER_POSITION = (1.0, 0.0, 0.036)
BIN_POSITION = (0.0, 2.0, 0.16)
BELOW_SHELF = (-1.0, 0.0, 0.037)


def describe_shelf(x: float, y: float) -> dict[str, Any]:
    """Return a shelf too low for grasps from above."""
    return {"name": "shelf", "type": "box", "size": [0.6, 0.6, 0.02], "position": [x, y, 0.22]}


def make_littered_scene(*obstacles: dict[str, Any]) -> Scene:
    """Return the scene with litter, the bin and `obstacles`."""
    container = {
        "name": "bin",
        "type": "urdf",
        "file": "furniture/bin.urdf",
        "position": [*BIN_POSITION[:2], 0.0],
    }
    document = {
        "name": "litter",
        "robot": "husky_ur5e",
        "start": {"base": [0.0, 0.0, 0.0], "arm": "home"},
        "arena": {"x": [-3.0, 3.0], "y": [-3.0, 3.0]},
        "objects": [{"name": "litter", "type": "litter", "position": list(LITTER_POSITION)}],
        "obstacles": [container, *obstacles],
    }
    return Scene.from_document(document, find_resource_folder("scenes"))
