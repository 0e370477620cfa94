"""Runs tests with faults in random lines: `python -m tests.mutants --sample 100 --seed 1`."""

from __future__ import annotations

import argparse
import hashlib
import importlib
import itertools
import json
import os
import random
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from .mutations import Mutant, iterate_mutants
from .plugin import PACKAGE, Recorder, Replacer

ROOT = PACKAGE.parent
MODULES = ["validation", "planning/chain", "planning/solver", "planning/nlp", "world/scene"]
TESTS = [f"tests/{name}" for name in MODULES] + ["tests/planning/test_solve_task.py"]
IMPORTED = (
    "casadi",
    "coal",
    "hypothesis",
    "pinocchio",
    "pydantic",
    "scipy.optimize",
    "toppra",
    "trimesh",
)
MAX_SECONDS = 60.0  # [s] of CPU time after which a fault counts as survived
PATIENCE = 5.0  # time limit of a test: 30 s plus this multiple of its time without the fault


def print_line(line: str) -> None:
    """Print a line and flush."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


class Executed(NamedTuple):
    """Execution of a test without a fault: CPU time [s], and module → executed lines."""

    seconds: float
    lines: Mapping[str, Sequence[int]]


Coverage = dict[str, dict[str, Executed]]  # file → id → test; the id "" denotes imports


def list_files(names: Sequence[str], root: Path, pattern: str) -> list[str]:
    """Return the files in folders below `root`, relative to it.

    Raises:
        SystemExit: A file or folder does not exist.
    """
    paths = [root / name for name in names]
    for path in paths:
        if not path.exists():
            raise SystemExit(f"no such file or folder: {path}")
    files = [p for path in paths for p in ([path] if path.is_file() else path.rglob(pattern))]
    return sorted({str(file.relative_to(root)) for file in files})


def sample_mutants(modules: Sequence[str], count: int, seed: int) -> list[Mutant]:
    """Return faults of random lines: one fault of each line before a second one of any line."""
    lines = defaultdict[tuple[str, int], list[Mutant]](list)
    for module in modules:
        for mutant in iterate_mutants(module, (PACKAGE / module).read_text(encoding="utf-8")):
            lines[module, mutant.line].append(mutant)
    rng = random.Random(seed)
    order = []
    for faults in lines.values():
        rng.shuffle(faults)
        place = rng.random()
        order += [(turn, place, mutant) for turn, mutant in enumerate(faults)]
    return [mutant for *_, mutant in sorted(order, key=lambda item: item[:2])[:count]]


def run_tests(files: Sequence[str], folder: Path, make_plugin: Callable[[], Any]) -> bool:
    """Return whether tests pass with a pytest plugin; `pytest.log` has the failures.

    The tests run in a fork of this process, which has imported all dependencies of the package.
    """
    if child := os.fork():
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        return status in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED)
    status: int = pytest.ExitCode.INTERNAL_ERROR
    try:
        log = os.open(folder / "pytest.log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(log, 1)
        os.dup2(log, 2)
        marks = ["-m", "not long and not browser"]
        options = ["-x", "-q", "-p", "no:cacheprovider", "--rootdir", str(ROOT), *marks]
        status = pytest.main([*options, *files], [make_plugin()])
    finally:
        sys.stdout.flush()
        os._exit(status)


def measure_coverage(files: Sequence[str], folder: Path) -> Coverage:
    """Return the lines that each test executes, cached in a folder until a source changes.

    Raises:
        SystemExit: A test fails without a fault.
    """
    common = hashlib.sha256()
    for path in sorted([*PACKAGE.rglob("*.py"), *(ROOT / "tests" / "helpers").rglob("*.py")]):
        common.update(path.read_bytes())
    coverage: Coverage = {}
    folder.mkdir(parents=True, exist_ok=True)
    for number, file in enumerate(files, 1):
        digest = common.copy()
        digest.update((ROOT / file).read_bytes())
        record = folder / f"{file.replace('/', '.')}.{digest.hexdigest()[:16]}.json"
        if not record.exists():
            for old in folder.glob(f"{file.replace('/', '.')}.*.json"):
                old.unlink()
            print_line(f"recording {number} of {len(files)}: {file}")
            if not run_tests([file], folder, lambda path=record: Recorder(path)):
                raise SystemExit(f"{file} fails without a fault: see {folder / 'pytest.log'}")
        tests = json.loads(record.read_text(encoding="utf-8"))
        coverage[file] = {name: Executed(*test) for name, test in tests.items()}
    return coverage


def select_tests(mutant: Mutant, coverage: Coverage) -> list[str]:
    """Return the tests that may detect a fault, in the order of execution.

    Tests that execute the line come first: those in the module's own test file, then those in its
    folder, quick tests before slow ones. The other tests of these files follow, since only the
    first test of a file executes shared fixtures. A line that is executed at import selects all
    tests that execute any line of its module. No test begins after MAX_SECONDS.
    """
    module = Path("tests", mutant.module)
    own_tests = module.with_name(f"test_{module.stem}")
    users, order = set(mutant.users), []
    executed, imported = dict[str, set[int]](), set[int]()
    for tests_of_file in coverage.values():
        executed |= {
            name: set(test.lines.get(mutant.module, ())) for name, test in tests_of_file.items()
        }
        imported |= executed.pop("")
    if users <= imported:
        users = set().union(*executed.values())
    for file, tests in coverage.items():
        chosen = {name for name in tests if name and users & executed[name]}
        cost = sum(tests[name].seconds for name in chosen)
        far = [not file.startswith(str(near)) for near in (own_tests, own_tests.parent)]
        for name, test in tests.items() if chosen else ():
            place = (name not in chosen, far, cost, file, test.seconds)
            order.append((*place, name))
    order = sorted(entry for entry in order if entry[-1])
    begins = itertools.accumulate((seconds for *_, seconds, _ in order), initial=0.0)
    return [name for (*_, name), begin in zip(order, begins, strict=False) if begin < MAX_SECONDS]


def run_mutant(mutant: Mutant, coverage: Coverage, folder: Path) -> str:
    """Return "killed", "survived", or "uncovered" if no test executes the line."""
    selected = select_tests(mutant, coverage)
    if not selected:
        return "uncovered"
    tests = {
        name: test for tests_of_file in coverage.values() for name, test in tests_of_file.items()
    }
    limits = {name: 30.0 + PATIENCE * tests[name].seconds for name in selected}
    files = list(dict.fromkeys(name.partition("::")[0] for name in selected))
    passed = run_tests(files, folder, lambda: Replacer(mutant.module, mutant.source, limits))
    return "survived" if passed else "killed"


def main() -> int:
    """Run tests with sampled faults; return 1 unless all faults are killed."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("--sample", type=int, default=100, help="number of faults")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--modules", nargs="+", default=MODULES, help="folders and modules")
    parser.add_argument("--tests", nargs="+", default=TESTS, help="folders and files of tests")
    options = parser.parse_args()
    folder = ROOT / "out" / "mutants"
    os.environ["OMP_NUM_THREADS"] = "1"
    for name in IMPORTED:
        importlib.import_module(name)
    coverage = measure_coverage(list_files(options.tests, ROOT, "test_*.py"), folder)
    counts = Counter(dict.fromkeys(("killed", "survived", "uncovered"), 0))
    sample = sample_mutants(
        list_files(options.modules, PACKAGE, "*.py"), options.sample, options.seed
    )
    for number, mutant in enumerate(sample, 1):
        outcome = run_mutant(mutant, coverage, folder)
        counts[outcome] += 1
        place = f"{mutant.module}:{mutant.line}: {mutant.change}"
        print_line(f"{number} of {len(sample)}, {counts['killed']} killed: {outcome}: {place}")
        if outcome != "killed":
            print_line(f"    {mutant.text}")
    summary = ", ".join(f"{count} {name}" for name, count in counts.items())
    print_line(f"{summary}: {counts['killed'] / max(len(sample), 1):.0%} killed")
    return int(len(sample) > counts["killed"])


if __name__ == "__main__":
    sys.exit(main())
