"""Handles mimic joints: several joints that share one coordinate, as in a telescope."""
