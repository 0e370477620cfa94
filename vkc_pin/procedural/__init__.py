"""Generates random furniture, rooms and tasks."""
