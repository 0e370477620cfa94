"""What a dataset is to be: recipes, and the constraints that they name."""
