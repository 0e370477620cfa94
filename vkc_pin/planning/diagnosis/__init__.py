"""Explains why a task cannot be solved."""
