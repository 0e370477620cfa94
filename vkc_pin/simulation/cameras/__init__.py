"""Models cameras on a robot, and renders their images of an executed motion."""
