"""Judges all episodes of a dataset with the oracle, and resumes an interrupted run.

Usage: python -m tests.episodes DATASET --jobs N
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tests.oracle.agreement import format_table

from .judged import judge_dataset


def main(arguments: list[str] | None = None) -> int:
    """Judge a dataset; return 1 if the oracle rejects an episode or cannot judge it."""
    parser = argparse.ArgumentParser(prog="python -m tests.episodes", description=__doc__)
    parser.add_argument("dataset", type=Path, help="folder of a dataset")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    options = parser.parse_args(arguments)
    verdicts = judge_dataset(options.dataset, jobs=options.jobs)
    sys.stdout.write(format_table(verdicts) + "\n")
    return int(any(verdict.found or verdict.unjudged for verdict in verdicts))


if __name__ == "__main__":
    sys.exit(main())
