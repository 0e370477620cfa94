"""Imports robots from files of other programs, and derives a robot.yaml."""
