"""Judges saved plans, and writes verdicts.jsonl and agreement.md into a folder.

Usage: python -m tests.oracle FOLDER_OR_PLAN ...
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from .agreement import format_table, judge_all, record_violations, write_verdicts


def main(arguments: list[str] | None = None) -> int:
    """Judge; 1 if a plan is a success by its own word and not by the oracle's."""
    parser = argparse.ArgumentParser(prog="python -m tests.oracle", description=__doc__)
    parser.add_argument(
        "paths", nargs="+", type=Path, help="saved plans (.npz), or folders with some"
    )
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument(
        "--record",
        type=Path,
        help="results.json of the only folder's trials, in which verdicts are noted",
    )
    given = parser.parse_args(arguments)
    if given.record and len(given.paths) > 1:
        parser.error("--record is of one folder")
    wrong = 0
    for path in given.paths:
        verdicts = judge_all(
            sorted(path.rglob("*.npz")) if path.is_dir() else [path], jobs=given.jobs
        )
        if path.is_dir():
            write_verdicts(verdicts, path)
        if given.record:
            record_violations(verdicts, given.record)
        print(format_table(verdicts))
        wrong += sum(bool(verdict.success and verdict.found) for verdict in verdicts)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
