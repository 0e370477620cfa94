"""Robots and articulated objects as Pinocchio models with shapes and limits."""
