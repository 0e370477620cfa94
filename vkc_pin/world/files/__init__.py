"""Reads descriptions and meshes, and writes files atomically, without knowledge of robots."""
