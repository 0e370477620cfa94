"""Runs fuzz cases of all kinds and prints a table of their outcomes.

Usage: python -m tests.fuzz --cases 20000 --seed 1
"""

from __future__ import annotations

import argparse
import hashlib
import json
import random
import sys
from collections import Counter
from pathlib import Path

from .running import BAD, KINDS, Worker

CORPUS = Path(__file__).with_name("corpus")


def main() -> int:
    """Run cases; return 1 if something is wrong with one of them."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=1000, help="how many, of all kinds together")
    parser.add_argument("--seed", type=int, help="a new one by default, which is printed")
    parser.add_argument("--kind", choices=KINDS, help="this kind alone")
    parser.add_argument(
        "--first", type=int, default=0, help="the number of the first case of each kind"
    )
    parser.add_argument(
        "--keep",
        action="store_true",
        help="write what goes wrong into the corpus, a file for each error",
    )
    parser.add_argument(
        "--show", type=int, metavar="NUMBER", help="print one case of --kind and its outcome"
    )
    given = parser.parse_args()
    if given.seed is None:
        given.seed = random.SystemRandom().randrange(10**6)
        sys.stdout.write(f"--seed {given.seed}\n")
    worker, rows, seen, bad = Worker(), [], Counter[str](), 0
    if given.show is not None:
        asked = {"kind": given.kind, "seed": given.seed, "number": given.show}
        found = {**worker.run(**asked, only="make"), **worker.run(**asked)}
        sys.stdout.write(json.dumps(found, indent=1) + "\n")
        return 0
    for kind, share in KINDS.items():
        if given.kind not in (None, kind):
            continue
        count = given.cases if given.kind else round(given.cases * share)
        outcomes, longest, largest = Counter[str](), 0.0, 0.0
        for number in range(given.first, given.first + count):
            asked = {"kind": kind, "seed": given.seed, "number": number}
            found = worker.run(**asked)
            outcomes[found["outcome"]] += 1
            longest, largest = max(longest, found["seconds"]), max(largest, found["grown"])
            if found["outcome"] not in BAD:
                continue
            bad += 1
            error = found["error"].partition(": ")[0] if found["outcome"] == "raw" else ""
            key = f"{kind} {found['outcome']} {error}"
            seen[key] += 1
            if seen[key] == 1:
                sys.stdout.write(
                    f"{kind} {given.seed} {number}: {found['outcome']}, {found['error']}\n"
                )
                sys.stdout.flush()
                if given.keep:
                    save_case(kind, worker.run(**asked, only="make")["case"], found)
        rows.append((kind, count, outcomes, longest, largest))
    good = sorted({name for _, _, outcomes, _, _ in rows for name in outcomes} - set(BAD))
    columns = [*good, *BAD]
    sys.stdout.write(
        " ".join(f"{name:>9}" for name in ("kind", "cases", *columns, "seconds", "MB")) + "\n"
    )
    for kind, count, outcomes, longest, largest in rows:
        cells = [f"{outcomes[name]:9d}" for name in columns]
        sys.stdout.write(f"{kind:>9} {count:9d} {' '.join(cells)} {longest:9.1f} {largest:9.0f}\n")
    for key, number in seen.most_common():
        sys.stdout.write(f"{number:6d} {key}\n")
    worker.close()
    return 1 if bad else 0


def save_case(kind: str, case: dict[str, object], found: dict[str, str]) -> None:
    """Write a case into the corpus."""
    CORPUS.mkdir(exist_ok=True)
    text = json.dumps(
        {"kind": kind, "was": f"{found['outcome']}: {found['error']}", "case": case}, indent=1
    )
    name = hashlib.sha256(json.dumps(case).encode()).hexdigest()[:10]
    (CORPUS / f"{kind}_{name}.json").write_text(text + "\n", encoding="ascii")


if __name__ == "__main__":
    sys.exit(main())
