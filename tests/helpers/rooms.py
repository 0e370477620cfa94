"""Describes a small room in YAML."""

from __future__ import annotations

from pathlib import Path

from vkc_pin.world.scene.scene import Scene, load_scene

TINY = """\
robot: husky_ur5e
start:
  base: [0.0, 0.0, 0.5]
  arm: home
start_region: {x: [-1, 1], y: [-1, 1], yaw: any}
arena: {x: [-4, 4], y: [-3, 3]}
objects:
  - name: front
    type: door
    position: [3, 0, 0]
    state: {hinge: 0.3}
obstacles:
  - {name: crate, type: box, size: [0.5, 0.4, 0.3], position: [2, 2, 0.15], \
yaw: 0.2, colour: [1, 0, 0]}
  - name: post
    type: cylinder
    radius: 0.1
    length: 1.0
    position: [-2, 2, 0.5]
"""


def load_scene_text(folder: Path, text: str) -> Scene:
    file = folder / "room.yaml"
    file.write_text(text)
    return load_scene(file)
