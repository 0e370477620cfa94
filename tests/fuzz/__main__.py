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
    """Run cases; return 1 if one of them fails."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=1000, help="total number of cases")
    parser.add_argument("--seed", type=int, help="random seed; a new one by default, printed")
    parser.add_argument("--kind", choices=KINDS, help="run only this kind")
    parser.add_argument(
        "--first", type=int, default=0, help="number of the first case of each kind"
    )
    parser.add_argument(
        "--keep",
        action="store_true",
        help="add failing cases to the corpus, one for each error",
    )
    parser.add_argument(
        "--show", type=int, metavar="NUMBER", help="print one case of --kind and its outcome"
    )
    arguments = parser.parse_args()
    if arguments.seed is None:
        arguments.seed = random.SystemRandom().randrange(10**6)
        sys.stdout.write(f"--seed {arguments.seed}\n")
    worker, rows, errors, failures = Worker(), [], Counter[str](), 0
    if arguments.show is not None:
        request = {"kind": arguments.kind, "seed": arguments.seed, "number": arguments.show}
        result = {**worker.run(**request, only="make"), **worker.run(**request)}
        sys.stdout.write(json.dumps(result, indent=1) + "\n")
        return 0
    for kind, share in KINDS.items():
        if arguments.kind not in (None, kind):
            continue
        count = arguments.cases if arguments.kind else round(arguments.cases * share)
        outcomes, longest, largest = Counter[str](), 0.0, 0.0
        for number in range(arguments.first, arguments.first + count):
            request = {"kind": kind, "seed": arguments.seed, "number": number}
            result = worker.run(**request)
            outcomes[result["outcome"]] += 1
            longest, largest = max(longest, result["seconds"]), max(largest, result["grown"])
            if result["outcome"] not in BAD:
                continue
            failures += 1
            error = result["error"].partition(": ")[0] if result["outcome"] == "raw" else ""
            key = f"{kind} {result['outcome']} {error}"
            errors[key] += 1
            if errors[key] == 1:
                sys.stdout.write(
                    f"{kind} {arguments.seed} {number}: {result['outcome']}, {result['error']}\n"
                )
                sys.stdout.flush()
                if arguments.keep:
                    save_case(kind, worker.run(**request, only="make")["case"], result)
        rows.append((kind, count, outcomes, longest, largest))
    good = sorted({name for _, _, outcomes, _, _ in rows for name in outcomes} - set(BAD))
    columns = [*good, *BAD]
    sys.stdout.write(
        " ".join(f"{name:>9}" for name in ("kind", "cases", *columns, "seconds", "MB")) + "\n"
    )
    for kind, count, outcomes, longest, largest in rows:
        cells = [f"{outcomes[name]:9d}" for name in columns]
        sys.stdout.write(f"{kind:>9} {count:9d} {' '.join(cells)} {longest:9.1f} {largest:9.0f}\n")
    for key, number in errors.most_common():
        sys.stdout.write(f"{number:6d} {key}\n")
    worker.close()
    return 1 if failures else 0


def save_case(kind: str, case: dict[str, object], result: dict[str, str]) -> None:
    """Write a case into the corpus."""
    CORPUS.mkdir(exist_ok=True)
    text = json.dumps(
        {"kind": kind, "was": f"{result['outcome']}: {result['error']}", "case": case}, indent=1
    )
    name = hashlib.sha256(json.dumps(case).encode()).hexdigest()[:10]
    (CORPUS / f"{kind}_{name}.json").write_text(text + "\n", encoding="ascii")


if __name__ == "__main__":
    sys.exit(main())
