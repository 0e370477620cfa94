"""Compares this package with trajopt, OMPL, roboplan and both baselines."""
