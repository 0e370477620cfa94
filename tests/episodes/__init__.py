"""Judges every episode of a dataset with the oracle: `python -m tests.episodes DATASET`."""
