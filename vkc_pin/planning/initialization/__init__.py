"""Generates initial guesses for the solver."""
