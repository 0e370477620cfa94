"""Datasets: how fast they are made."""
