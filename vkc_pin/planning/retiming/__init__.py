"""Retimes trajectories: a smooth path through waypoints, at the highest speed within limits."""
