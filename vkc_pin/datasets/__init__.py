"""Generates, writes and checks datasets of validated trajectories."""
