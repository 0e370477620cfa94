"""The experiments, each with every trial on record."""
