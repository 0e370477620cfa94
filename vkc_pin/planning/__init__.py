"""Tries seeds until the validation accepts a motion: steps one by one, all at once, or in a window that slides along."""
