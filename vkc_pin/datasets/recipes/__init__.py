"""Describes datasets by recipes and named constraints."""
