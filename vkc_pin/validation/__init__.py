"""Checks trajectories independently of the planner."""
