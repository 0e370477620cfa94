"""Measures settings and initial guesses on sixty problems that were not used for tuning."""
