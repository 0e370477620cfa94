"""Motions over time, the scene along them, and both as files."""
