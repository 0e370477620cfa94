"""Episodes as files."""
