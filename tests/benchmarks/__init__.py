"""Measures planning: benchmarks for developers."""
