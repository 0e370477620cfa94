"""Represents motions over time, the world along them, and their file formats."""
