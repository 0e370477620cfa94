"""Checks rates and motor torques along a motion, and finds the limits that bound its speed."""
