"""Describes a scene: the robot and its start, obstacles, articulated objects and grasps."""

from vkc_pin.world.scene.scene import Scene, load_scene

__all__ = ["Scene", "load_scene"]
