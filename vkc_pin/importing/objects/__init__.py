"""Imports articulated objects from URDF, MJCF and SDF files."""
