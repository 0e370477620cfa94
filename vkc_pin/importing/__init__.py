"""Imports robots, objects and homes from files of other programs, and proposes attachments."""
