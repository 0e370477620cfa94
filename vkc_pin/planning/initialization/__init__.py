"""Trajectories for the solver to start from."""
