"""Computes motor torques of the arm and contact wrenches of the hand along a motion."""
