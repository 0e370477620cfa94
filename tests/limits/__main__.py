"""Checks saved plans and their exported tables against limits; `--make N` plans first.

Usage: python -m tests.limits FOLDER_OR_FILE ...
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from .check import check_motion
from .files import read_csv, read_npz


def main(arguments: list[str] | None = None) -> int:
    """Check files; return 1 if a limit is violated."""
    parser = argparse.ArgumentParser(prog="python -m tests.limits", description=__doc__)
    parser.add_argument(
        "paths", nargs="+", type=Path, help="saved plans (.npz), or folders that contain them"
    )
    parser.add_argument(
        "--make",
        type=int,
        default=0,
        metavar="N",
        help="number of problems to plan first, into the first folder",
    )
    parser.add_argument("--first", type=int, default=0, help="number of the first problem")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    if options.make:
        from .plans import export_plans

        for _ in export_plans(
            options.paths[0], options.make, first=options.first, seed=options.seed
        ):
            pass
    plans, samples, violating, ratios = 0, 0, 0, [0.0, 0.0]
    for path in options.paths:
        for file in sorted(path.rglob("*.npz")) if path.is_dir() else [path]:
            motion, limits = read_npz(file)
            tables = [read_csv(table)] if (table := file.with_suffix(".csv")).is_file() else []
            excesses = []
            for each in (motion, *tables):
                verdict = check_motion(each, limits)
                excesses += verdict.excesses
                ratios = [max(ratios[0], verdict.velocity), max(ratios[1], verdict.acceleration)]
                samples += verdict.samples
            plans += 1
            violating += bool(excesses)
            sys.stdout.write("".join(f"{file}: {excess}\n" for excess in excesses))
    sys.stdout.write(
        f"{plans} plans, {samples} samples, {violating} plans with an excess; "
        f"velocities up to {ratios[0]:.9f} of their limits, accelerations up to {ratios[1]:.9f}\n"
    )
    return 1 if violating else 0


if __name__ == "__main__":
    sys.exit(main())
