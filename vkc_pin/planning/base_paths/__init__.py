"""Plans paths of the base on the floor with A*; depends on shapes and coal only."""
