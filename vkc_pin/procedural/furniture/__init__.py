"""Generates random furniture and appliances."""
