"""Formulates equations 1 to 7 as one nonlinear program."""
