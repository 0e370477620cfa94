"""Runs tests on faults at random places: `python -m tests.mutants --sample 100 --seed 1`."""

from __future__ import annotations

import argparse
import importlib.abc
import importlib.machinery
import importlib.util
import json
import os
import random
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from .mutations import Mutant, iterate_mutants

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "vkc_pin"
MODULES = ["validation", "planning/chain", "planning/solver", "planning/nlp", "world/scene"]
TESTS = [f"tests/{name}" for name in MODULES] + ["tests/planning/test_solve_task.py"]
PATIENCE = 5.0  # tests that take so many times as long as without the fault, and 30 s more, fail


def list_files(names: Sequence[str], root: Path, pattern: str) -> list[str]:
    """Return the files of folders and files below `root`, relative to it."""
    paths = [root / name for name in names]
    files = [p for path in paths for p in ([path] if path.is_file() else path.rglob(pattern))]
    return sorted({str(file.relative_to(root)) for file in files})


def sample_mutants(modules: Sequence[str], count: int, seed: int) -> list[Mutant]:
    """Return faults of random lines: one of each line before a second one of any."""
    lines = defaultdict[tuple[str, int], list[Mutant]](list)
    for module in modules:
        for mutant in iterate_mutants(module, (PACKAGE / module).read_text(encoding="utf-8")):
            lines[module, mutant.line].append(mutant)
    rng = random.Random(seed)
    order = []
    for own in lines.values():
        rng.shuffle(own)
        place = rng.random()
        order += [(turn, place, mutant) for turn, mutant in enumerate(own)]
    return [mutant for *_, mutant in sorted(order, key=lambda item: item[:2])[:count]]


def run_tests(file: str, *arguments: str, timeout: float | None = None) -> bool:
    """Return whether a file of tests passes, within some time [s]."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", file]
    command += ["-m", "not long and not browser", "-p", "tests.mutants.__main__"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    environment["MUTANTS"] = json.dumps(arguments)
    try:
        done = subprocess.run(
            command, cwd=ROOT, env=environment, timeout=timeout, capture_output=True, check=False
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode in (0, 5)


def measure_coverage(files: Sequence[str], folder: Path) -> dict[str, tuple[float, set[str]]]:
    """Return file of tests → its time [s], and the lines that it executes as "module:line".

    Raises:
        SystemExit: A test fails without a fault.
    """
    found = {}
    folder.mkdir(parents=True, exist_ok=True)
    for file in files:
        record = folder / f"{file.replace('/', '.')}.json"
        began = time.perf_counter()
        if not run_tests(file, "record", str(record)):
            raise SystemExit(f"{file} fails without a fault")
        lines = json.loads(record.read_text(encoding="utf-8"))
        found[file] = (time.perf_counter() - began, set(lines))
    return found


def run_mutant(mutant: Mutant, coverage: dict[str, tuple[float, set[str]]], folder: Path) -> str:
    """Return "killed", "survived", or "uncovered" where no test executes the line."""
    changed = {f"{mutant.module}:{line}" for line in mutant.users}
    files = [file for file, (_, lines) in coverage.items() if changed & lines]
    source = folder / "mutant.py"
    source.write_text(mutant.source, encoding="utf-8")
    mirror = f"tests/{Path(mutant.module).parent}/test_{Path(mutant.module).stem}"
    for file in sorted(files, key=lambda name: (not name.startswith(mirror), coverage[name][0])):
        limit = 30.0 + PATIENCE * coverage[file][0]
        if not run_tests(file, "replace", mutant.module, str(source), timeout=limit):
            return "killed"
    return "survived" if files else "uncovered"


class Replacer(importlib.abc.MetaPathFinder):
    """Finds one module of the package in another file."""

    def __init__(self, module: str, source: str) -> None:
        self.name = "vkc_pin." + module.removesuffix(".py").replace("/", ".")
        self.module, self.source = PACKAGE / module, Path(source).read_text(encoding="utf-8")

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> Any:
        if fullname != self.name:
            return None
        loader = importlib.machinery.SourceFileLoader(fullname, str(self.module))
        code = compile(self.source, str(self.module), "exec", dont_inherit=True)
        loader.get_code = lambda _: code  # type: ignore[method-assign]
        return importlib.util.spec_from_file_location(fullname, self.module, loader=loader)


class Recorder:
    """Writes down which lines of the package tests execute."""

    def __init__(self, record: str) -> None:
        self.record, self.lines, self.prefix = Path(record), set[str](), f"{PACKAGE}/"
        sys.settrace(self.trace)

    def trace(self, frame: FrameType, event: str, argument: Any) -> Any:
        name = frame.f_code.co_filename
        if not name.startswith(self.prefix):
            return None
        self.lines.add(f"{name.removeprefix(self.prefix)}:{frame.f_lineno}")
        return self.trace

    def pytest_sessionfinish(self) -> None:
        sys.settrace(None)
        self.record.write_text(json.dumps(sorted(self.lines)), encoding="utf-8")


def start_plugin() -> Recorder | None:
    """Replace a module or record lines, before `tests/conftest.py` imports the package."""
    does, *arguments = json.loads(os.environ["MUTANTS"])
    if does == "record":
        return Recorder(*arguments)
    sys.meta_path.insert(0, Replacer(*arguments))
    return None


PLUGIN = start_plugin() if __name__ != "__main__" and "MUTANTS" in os.environ else None


def pytest_configure(config: pytest.Config) -> None:
    """Register the recorder in the process that runs the tests."""
    if PLUGIN is not None:
        config.pluginmanager.register(PLUGIN)


def main() -> int:
    """Run faults; return 1 if one survives."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("--sample", type=int, default=100, help="number of faults")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--modules", nargs="+", default=MODULES, help="folders and modules")
    parser.add_argument("--tests", nargs="+", default=TESTS, help="folders and files of tests")
    given = parser.parse_args()
    folder = ROOT / "out" / "mutants"
    coverage = measure_coverage(list_files(given.tests, ROOT, "test_*.py"), folder)
    counts = Counter[str]()
    modules = list_files(given.modules, PACKAGE, "*.py")
    for mutant in sample_mutants(modules, given.sample, given.seed):
        outcome = run_mutant(mutant, coverage, folder)
        counts[outcome] += 1
        if outcome != "killed":
            place = f"{mutant.module}:{mutant.line}"
            sys.stdout.write(f"{outcome}: {place}: {mutant.what}\n    {mutant.text}\n")
            sys.stdout.flush()
    sys.stdout.write(", ".join(f"{count} {name}" for name, count in counts.items()) + "\n")
    return int(counts.total() > counts["killed"])


if __name__ == "__main__":
    sys.exit(main())
