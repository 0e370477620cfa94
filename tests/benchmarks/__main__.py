"""Runs a benchmark: `python -m tests.benchmarks NAME --help`, in a checkout."""

import sys

from .commands import main

sys.exit(main(sys.argv[1:]))
