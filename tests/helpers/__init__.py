"""Scenes, plans and programs that several test files need."""
