"""Defines robots and articulated objects: Pinocchio models with convex shapes and limits."""
