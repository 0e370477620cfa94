"""Imports robots from URDF, xacro and MJCF files, and derives a robot.yaml."""
