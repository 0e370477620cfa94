"""Fuzzes the public API: invalid input must yield a result or one of the package's errors."""
