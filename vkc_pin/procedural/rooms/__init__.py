"""Rooms made by rule and number."""
