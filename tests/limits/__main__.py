"""Judges saved plans and the tables beside them; `--make N` plans first.

Usage: python -m tests.limits FOLDER_OR_FILE ...
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from .check import check_motion
from .files import read_csv, read_limits, read_npz


def main(arguments: list[str] | None = None) -> int:
    """Judge; 1 if a limit is not kept."""
    parser = argparse.ArgumentParser(prog="python -m tests.limits", description=__doc__)
    parser.add_argument(
        "paths", nargs="+", type=Path, help="saved plans (.npz), or folders with some"
    )
    parser.add_argument(
        "--make",
        type=int,
        default=0,
        metavar="N",
        help="plan so many problems first, into the first folder",
    )
    parser.add_argument("--first", type=int, default=0, help="the number of the first problem")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    if given.make:
        from .plans import export_plans

        for _ in export_plans(given.paths[0], given.make, first=given.first, seed=given.seed):
            pass
    plans, moments, wrong, shares = 0, 0, 0, [0.0, 0.0]
    for path in given.paths:
        for file in sorted(path.rglob("*.npz")) if path.is_dir() else [path]:
            motion, about = read_npz(file)
            tables = [read_csv(table)] if (table := file.with_suffix(".csv")).is_file() else []
            found = []
            for one in (motion, *tables):
                verdict = check_motion(one, read_limits(about, file))
                found += verdict.found
                shares = [max(shares[0], verdict.velocity), max(shares[1], verdict.acceleration)]
                moments += verdict.moments
            plans += 1
            wrong += bool(found)
            sys.stdout.write("".join(f"{file}: {excess}\n" for excess in found))
    sys.stdout.write(
        f"{plans} plans, {moments} moments, {wrong} plans with an excess; "
        f"velocities up to {shares[0]:.9f} of their limits, accelerations up to {shares[1]:.9f}\n"
    )
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
