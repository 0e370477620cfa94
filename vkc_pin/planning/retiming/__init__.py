"""Timing of motions: a smooth path through waypoints, and how fast it can be gone along."""
