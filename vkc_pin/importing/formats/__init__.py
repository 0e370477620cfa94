"""Reads the formats of other programs as descriptions."""
