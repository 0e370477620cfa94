"""Cameras on a robot, and what they see of what happened in physics."""
