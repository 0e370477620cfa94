"""Describes dynamics: masses, joint friction, damping and springs, and torque limits."""
