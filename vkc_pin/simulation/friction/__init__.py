"""Simulates grasps by friction: fingers, the pauses in which they close, and their loads."""
