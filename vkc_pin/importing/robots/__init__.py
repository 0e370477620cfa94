"""Robots from URDF, xacro and MJCF: what a robot.yaml needs is found in names and shapes."""
