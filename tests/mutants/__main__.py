"""`python -m tests.mutants --sample 200 --seed 1`: faults at random places, and whether tests notice them."""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

from .mutations import Mutant, mutants
from .running import PACKAGE, ROOT, measured, outcome, warm

# What judges motions, what is close, poses and their errors, and the solver.
MODULES = [
    "validation",
    "planning/chain/collision_pairs.py",
    "planning/chain/contacts.py",
    "planning/chain/easing.py",
    "planning/chain/pose.py",
    "planning/solver",
    "planning/nlp/merit.py",
]
MODULES += ["world/scene/contact_rules.py", "planning/solve_task.py"]
TESTS = [
    "tests/validation",
    "tests/planning/solver",
    "tests/oracle",
    "tests/planning/nlp/test_merit.py",
    "tests/planning/nlp/test_merit_numbers.py",
    "tests/planning/nlp/test_problem.py",
]
TESTS += ["tests/world/scene/test_contact_rules.py"]
TESTS += [
    f"tests/planning/chain/test_{name}.py"
    for name in (
        "collision_pairs",
        "contacts",
        "contacts_carried",
        "easing",
        "easing_parts",
        "pose",
        "inverse_kinematics",
    )
]
TESTS += [
    f"tests/planning/test_{name}.py"
    for name in (
        "solve_task",
        "pushes",
        "near_grasps",
        "riding",
        "plan_loaded",
        "infeasible",
    )
]


def drawn(modules: list[str], count: int, seed: int) -> list[Mutant]:
    """Return faults of modules: no line gives a second one before every line has given one.

    The order hangs on the seed and on the words of a line alone: what is written elsewhere does not
    change who else is drawn.
    """
    found: list[tuple[int, bytes, Mutant]] = []
    for module in modules:
        by_line: dict[int, list[Mutant]] = defaultdict(list)
        for mutant in mutants(module, (PACKAGE / module).read_text(encoding="utf-8")):
            by_line[mutant.line].append(mutant)
        for own in by_line.values():
            place = _lot(f"{seed} line {own[0].name}")
            own.sort(key=lambda mutant: _lot(f"{seed} {mutant.name}"))
            found += [(turn, place, mutant) for turn, mutant in enumerate(own)]
    return [mutant for *_, mutant in sorted(found, key=lambda item: item[:2])[:count]]


def _lot(text: str) -> bytes:
    return hashlib.sha256(text.encode()).digest()


def main() -> int:
    """Run faults; return 1 if one survives."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("--sample", type=int, default=200, help="how many faults")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--module",
        action="append",
        metavar="FILE",
        help="of this module alone, such as solver/loop.py; may be repeated",
    )
    parser.add_argument(
        "--most",
        type=float,
        default=60.0,
        metavar="S",
        help="CPU time of the tests of a fault (default 60 s)",
    )
    parser.add_argument(
        "--again",
        action="store_true",
        help="run those that survived once more, as after writing tests",
    )
    parser.add_argument("--json", type=Path, help="write what came of all of them here")
    given = parser.parse_args()
    paths = [
        path
        for name in MODULES
        for path in ([PACKAGE / name] if name.endswith(".py") else (PACKAGE / name).rglob("*.py"))
    ]
    every = sorted(str(path.relative_to(PACKAGE)) for path in paths)
    folder = ROOT / "out" / "mutants"
    warm()
    coverage = measured(every, TESTS, folder / "coverage")
    journal = folder / "journal.jsonl"
    known: dict[str, dict[str, Any]] = {}
    for line in journal.read_text(encoding="utf-8").splitlines() if journal.is_file() else ():
        row = json.loads(line)
        known[row["name"]] = row
    rows = []
    with journal.open("a", encoding="utf-8") as file:
        for mutant in drawn(given.module or every, given.sample, given.seed):
            row = known.get(mutant.name)
            again = given.again and row is not None and row["outcome"] in ("survived", "uncovered")
            if row is None or again:
                row = {
                    "name": mutant.name,
                    "line": mutant.line,
                    **outcome(mutant, coverage, folder / "log.txt", given.most),
                }
                file.write(json.dumps(row, ensure_ascii=False) + "\n")
                file.flush()
                if row["outcome"] in ("survived", "uncovered"):
                    sys.stdout.write(
                        f"{row['outcome']}: {mutant.module}:{mutant.line}: {mutant.what}\n    {mutant.at}\n"
                    )
                    sys.stdout.flush()
            rows.append({**row, "module": mutant.module})
    if given.json:
        about = {"sample": given.sample, "seed": given.seed}
        given.json.write_text(
            json.dumps({"meta": about, "trials": rows}, indent=1, ensure_ascii=False) + "\n",
            encoding="utf-8",
        )
    sys.stdout.write(table(rows))
    return int(any(row["outcome"] in ("survived", "uncovered") for row in rows))


def table(rows: list[dict[str, Any]]) -> str:
    """Return how many faults of each wing came to what, and the share that was noticed."""
    kinds = ("killed", "endless", "survived", "uncovered")
    lines = ["".join(f"{name:>12}" for name in ("", *kinds, "noticed"))]
    for wing in [*sorted({row["module"].partition("/")[0] for row in rows}), ""]:
        own = Counter(row["outcome"] for row in rows if row["module"].startswith(wing))
        noticed, all_of_them = own["killed"] + own["endless"], own.total()
        cells = [
            f"{wing or 'all':>12}",
            *(f"{own[kind]:12d}" for kind in kinds),
            f"{noticed / max(all_of_them, 1):12.1%}",
        ]
        lines.append("".join(cells))
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
