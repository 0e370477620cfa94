"""What stands where, what is held, and where the robot starts."""

from vkc_pin.world.scene.scene import Scene, load_scene

__all__ = ["Scene", "load_scene"]
