"""Tests the kinds of faults, and the selection of tests that execute a changed line."""

from __future__ import annotations

import ast
import subprocess
import sys

import pytest

from .__main__ import ROOT, Coverage, Executed, list_files, sample_mutants, select_tests
from .mutations import Mutant, iterate_mutants
from .plugin import PACKAGE

SOURCE = '''"""Docstring 3 < 4."""
__all__ = ["area"]
LIMIT = 5.0


class Kept:
    count: int = 2

    def area(self, width: float, height: float) -> float:
        """Return 1 + 1."""
        if width < 0 and not height:
            raise ValueError(f"{width + 1}")
        detail = f"{2 * width} wide"
        self.count += 1
        print(detail)
        return min(width, LIMIT) * height
'''


def list_changes() -> set[str]:
    return {mutant.change for mutant in iterate_mutants("x.py", SOURCE)}


@pytest.mark.parametrize(
    "change",
    [
        "comparison: < → <=",
        "comparison: < → >=",
        "boolean: and → or",
        "sign: not height → (height)",
        "constant: 5.0 → 10.0",
        "constant: 0 → 1",
        "dropped: self.count += 1 → pass",
        "dropped: print(detail) → pass",
        "name: min → max",
        "swapped: width, LIMIT → LIMIT, width",
        "arithmetic: * → /",
    ],
)
def test_faults_are_of_all_kinds(change: str) -> None:
    assert change in list_changes()


def test_fault_changes_one_line_of_valid_source() -> None:
    for mutant in iterate_mutants("x.py", SOURCE):
        assert ast.dump(ast.parse(mutant.source)) != ast.dump(ast.parse(SOURCE))
        before, after = SOURCE.splitlines(), mutant.source.splitlines()
        assert [
            k for k, (one, other) in enumerate(zip(before, after, strict=True), 1) if one != other
        ] == [mutant.line]
        assert mutant.text == before[mutant.line - 1].strip()


def test_strings_annotations_and_errors_are_unchanged() -> None:
    changed = {mutant.line for mutant in iterate_mutants("x.py", SOURCE)}
    lines = SOURCE.splitlines()
    assert not {
        k
        for k in changed
        if any(
            word in lines[k - 1]
            for word in ("Docstring", "__all__", "raise", "detail =", "Return 1")
        )
    }


def test_users_of_a_constant_are_the_lines_that_read_it() -> None:
    found = {
        mutant.change: (mutant.line, mutant.users) for mutant in iterate_mutants("x.py", SOURCE)
    }
    assert found["constant: 5.0 → 10.0"] == (3, (16,))
    assert found["name: min → max"] == (16, (16,))


def test_users_are_the_lines_of_the_statement_or_of_reads() -> None:
    source = "A = 1\nB = 2\n\n\ndef double() -> int:\n    return (\n        2\n        * A\n    )\n"
    users = {mutant.change: mutant.users for mutant in iterate_mutants("x.py", source)}
    assert users["constant: 1 → 2"] == (8,)
    assert users["constant: 2 → 3"] == (6, 7, 8, 9)  # last: B has no user
    assert users["arithmetic: * → /"] == (6, 7, 8, 9)


def make_coverage(module: str) -> Coverage:
    """Return five tests in three files; only the import executes line 3."""
    executed = {
        "tests/planning/test_plan.py": {"fast": (0.1, [7]), "slow": (90.0, [7, 8])},
        "tests/world/scene/test_poses.py": {"own": (1.0, [7]), "other": (0.5, [9])},
        "tests/world/test_links.py": {"far": (0.1, [9])},
    }
    return {
        file: {"": Executed(0.0, {module: [1, 3]})}
        | {
            f"{file}::{name}": Executed(time, {module: lines})
            for name, (time, lines) in tests.items()
        }
        for file, tests in executed.items()
    }


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        # the module's own file first, quick tests first, and no test after one of 90 s
        (7, ["own", "fast", "slow"]),
        (8, ["slow"]),
        # the first test of a file executes shared fixtures
        (9, ["other", "far", "own"]),
        (3, ["other", "own", "far", "fast", "slow"]),
        (5, []),
    ],
)
def test_tests_that_execute_the_line_come_first(line: int, expected: list[str]) -> None:
    mutant = Mutant("world/scene/poses.py", line, "constant: 1 → 2", "x = 1", (line,), "x = 2")
    tests = select_tests(mutant, make_coverage("world/scene/poses.py"))
    assert [test.partition("::")[2] for test in tests] == expected


@pytest.mark.long
def test_command_reports_faults_and_reuses_coverage() -> None:
    command = [sys.executable, "-m", "tests.mutants", "--sample", "4", "--seed", "2"]
    command += ["--modules", "experiments/harness/runner.py"]
    command += ["--tests", "tests/experiments/harness/test_runner.py"]
    for _ in range(2):
        process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    *lines, summary = process.stdout.splitlines()
    assert summary == "1 killed, 1 survived, 2 uncovered: 25% killed", process.stdout
    assert process.returncode == 1
    place = "experiments/harness/runner.py:45: constant: 12 → 13"
    assert [line for line in lines if "survived" in line and line.endswith(place)]
    assert lines[0].startswith("1 of 4, "), "the second run reuses the coverage"


def test_unknown_files_end_the_command() -> None:
    with pytest.raises(SystemExit, match=r"no such file or folder: .*validation/swept"):
        list_files(["validation/collisions.py", "validation/swept"], PACKAGE, "*.py")


def test_sample_has_one_fault_of_each_line_first() -> None:
    modules = list_files(["errors.py", "utils/budget.py"], PACKAGE, "*.py")
    sample = sample_mutants(modules, 20, 1)
    assert sample == sample_mutants(modules, 20, 1) != sample_mutants(modules, 20, 2)
    assert len({(mutant.module, mutant.line) for mutant in sample}) == 20
