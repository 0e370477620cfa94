"""Descriptions and meshes: reads them, and writes files whole; knows no robot."""
