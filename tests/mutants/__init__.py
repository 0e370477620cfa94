"""Checks whether the tests detect small faults in the package.

`python -m tests.mutants --sample 100 --seed 1` samples faults, runs the tests that execute the
changed line of each fault, and prints the faults that no test detects.
"""
