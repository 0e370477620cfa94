"""Reads and writes motions as archives of plans, tables, JSON, and ROS messages."""
