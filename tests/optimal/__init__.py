"""Compares durations of motions with the least durations along their paths, by TOPP-RA."""
