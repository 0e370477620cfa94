"""Robots, objects and homes from files that were made for other programs."""
