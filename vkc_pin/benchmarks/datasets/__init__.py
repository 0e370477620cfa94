"""Measures and simulates the generation of datasets."""
