"""Judges saved plans, and writes verdicts.jsonl and agreement.md into a folder.

Usage: python -m tests.oracle FOLDER_OR_PLAN ...
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from .agreement import format_table, judge_all, record_violations, write_verdicts


def main(arguments: list[str] | None = None) -> int:
    """Judge plans; return 1 if the oracle finds violations in a plan that claims success."""
    parser = argparse.ArgumentParser(prog="python -m tests.oracle", description=__doc__)
    parser.add_argument(
        "paths", nargs="+", type=Path, help="saved plans (.npz), or folders that contain them"
    )
    parser.add_argument("--jobs", type=int, default=1, help="number of processes")
    parser.add_argument(
        "--record",
        type=Path,
        help="results.json of the folder's trials, to which verdicts are added",
    )
    options = parser.parse_args(arguments)
    if options.record and len(options.paths) > 1:
        parser.error("--record needs a single folder")
    false_successes = 0
    for path in options.paths:
        verdicts = judge_all(
            sorted(path.rglob("*.npz")) if path.is_dir() else [path], jobs=options.jobs
        )
        if path.is_dir():
            write_verdicts(verdicts, path)
        if options.record:
            record_violations(verdicts, options.record)
        print(format_table(verdicts))
        false_successes += sum(bool(verdict.success and verdict.found) for verdict in verdicts)
    return 1 if false_successes else 0


if __name__ == "__main__":
    sys.exit(main())
