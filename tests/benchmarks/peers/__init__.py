"""Compares this package with trajopt, OMPL, roboplan, HPP and both baselines."""
