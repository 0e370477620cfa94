"""Paths of the base on the floor, by A*; knows shapes and coal, nothing else."""
