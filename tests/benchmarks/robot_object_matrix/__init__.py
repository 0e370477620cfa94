"""Opens objects with robots that they were not made for."""
