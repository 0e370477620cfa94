"""Imports homes from one large file of another program."""
