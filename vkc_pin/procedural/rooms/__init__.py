"""Generates random rooms."""
