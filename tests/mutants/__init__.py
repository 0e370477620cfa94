"""Do the tests notice when the code is wrong? Small faults, one at a time, in what judges motions and what finds them.

`python -m tests.mutants --sample 200 --seed 1` draws faults, runs the tests that execute the
changed line with each, and prints those that no test notices. What is known so far is kept in
out/mutants, so that a run that was stopped goes on.
"""
