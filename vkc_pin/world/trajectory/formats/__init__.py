"""Motions as files and messages: saved plans, tables, JSON, ROS."""
