"""Judges all episodes of a dataset by the oracle, and resumes an interrupted run.

Usage: python -m tests.episodes DATASET --jobs N
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tests.oracle.agreement import format_table

from .judged import judge_dataset


def main(arguments: list[str] | None = None) -> int:
    """Judge; 1 if the oracle refuses an episode, or cannot say."""
    parser = argparse.ArgumentParser(prog="python -m tests.episodes", description=__doc__)
    parser.add_argument("dataset", type=Path, help="folder of a dataset")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    given = parser.parse_args(arguments)
    verdicts = judge_dataset(given.dataset, jobs=given.jobs)
    sys.stdout.write(format_table(verdicts) + "\n")
    return int(any(one.found or one.unjudged for one in verdicts))


if __name__ == "__main__":
    sys.exit(main())
