"""Runs the experiments and records every trial."""
