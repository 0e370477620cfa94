"""Compares durations of motions with the fastest along the same paths, by TOPP-RA."""
