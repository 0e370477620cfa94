"""Litter on the floor, with a shelf above it or a bin to put it into, and nothing else."""

from __future__ import annotations

from typing import Any

from vkc_pin.world.files.resources import find_resource_folder
from vkc_pin.world.scene.scene import Scene

AT, BIN, BELOW = (1.0, 0.0, 0.036), (0.0, 2.0, 0.16), (-1.0, 0.0, 0.037)


def describe_shelf(x: float, y: float) -> dict[str, Any]:
    """Return a shelf so low that nothing under it can be taken from above."""
    return {"name": "shelf", "type": "box", "size": [0.6, 0.6, 0.02], "position": [x, y, 0.22]}


def make_littered_scene(*obstacles: dict[str, Any]) -> Scene:
    """Return the scene with obstacles and, always, the bin."""
    inside = {
        "name": "bin",
        "type": "urdf",
        "file": "furniture/bin.urdf",
        "position": [*BIN[:2], 0.0],
    }
    document = {
        "name": "litter",
        "robot": "husky_ur5e",
        "start": {"base": [0.0, 0.0, 0.0], "arm": "home"},
        "arena": {"x": [-3.0, 3.0], "y": [-3.0, 3.0]},
        "objects": [{"name": "litter", "type": "litter", "position": list(AT)}],
        "obstacles": [inside, *obstacles],
    }
    return Scene.from_document(document, find_resource_folder("scenes"))
