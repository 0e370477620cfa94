"""Compiles steps and user terms to the phases of a task."""
