"""Imports articulated objects from files of other programs."""
