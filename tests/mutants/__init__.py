"""Checks whether tests notice small faults in the package.

`python -m tests.mutants --sample 100 --seed 1` draws faults, runs the tests that execute a changed
line with each of them, and prints those that no test notices.
"""
