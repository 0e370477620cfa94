"""Builds the virtual kinematic chain, its kinematics and its collision model."""
