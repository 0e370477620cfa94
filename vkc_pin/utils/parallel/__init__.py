"""What runs many tasks on many processes, and what keeps a record of it."""
