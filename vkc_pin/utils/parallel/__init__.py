"""Runs tasks in parallel and records their results."""
