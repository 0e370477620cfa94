"""Descriptions of robots, objects and homes, made from files that were made for other programs."""
