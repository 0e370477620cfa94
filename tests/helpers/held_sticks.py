"""Makes a scene in which the robot holds a stick, with which it can fetch a ball."""

from __future__ import annotations

from helpers.carrying import describe_stand, make_room
from vkc_pin.world.scene.scene import Scene


def make_scene_with_held_stick() -> Scene:
    scene = make_room(describe_stand(), objects=("stick", "ball"))
    return scene.with_held({"stick": "grip"}, at={"stick": (0.02, -0.1)})
