"""Datasets of checked motions: recipes, what makes episodes of them on many processes, files, and what is to be said of these."""
