"""Homes that can be planned in, made from one large file of another program."""
