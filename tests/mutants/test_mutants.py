"""Faults are made at every kind of place, and tests that execute a changed line find them."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from .__main__ import PACKAGE, list_files, measure_coverage, run_mutant, sample_mutants
from .mutations import iterate_mutants

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


def made() -> set[str]:
    return {mutant.what for mutant in iterate_mutants("x.py", SOURCE)}


@pytest.mark.parametrize(
    "what",
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
def test_faults_are_of_all_kinds(what: str) -> None:
    assert what in made()


def test_fault_changes_one_line_of_valid_source() -> None:
    for mutant in iterate_mutants("x.py", SOURCE):
        assert ast.dump(ast.parse(mutant.source)) != ast.dump(ast.parse(SOURCE))
        before, after = SOURCE.splitlines(), mutant.source.splitlines()
        assert [
            k for k, (one, other) in enumerate(zip(before, after, strict=True), 1) if one != other
        ] == [mutant.line]
        assert mutant.text == before[mutant.line - 1].strip()


def test_texts_types_and_errors_are_kept() -> None:
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


def test_users_of_a_constant_are_found() -> None:
    where = {mutant.what: (mutant.line, mutant.users) for mutant in iterate_mutants("x.py", SOURCE)}
    assert where["constant: 5.0 → 10.0"] == (3, (16,))
    assert where["name: min → max"] == (16, (16,))


@pytest.mark.long
def test_tests_find_a_fault(tmp_path: Path) -> None:
    module, file = "benchmarks/harness/limits.py", "tests/benchmarks/harness/test_limits.py"
    coverage = measure_coverage([file], tmp_path)
    outcomes = {
        mutant.what: run_mutant(mutant, coverage, tmp_path)
        for mutant in iterate_mutants(module, (PACKAGE / module).read_text(encoding="utf-8"))
        if "max_evaluations" in mutant.text and mutant.what.startswith("comparison")
    }
    assert outcomes == {"comparison: in → not in": "killed"}


def test_sample_has_one_fault_of_each_line_first() -> None:
    modules = list_files(["errors.py", "utils/budget.py"], PACKAGE, "*.py")
    sample = sample_mutants(modules, 20, 1)
    assert sample == sample_mutants(modules, 20, 1) != sample_mutants(modules, 20, 2)
    assert len({(mutant.module, mutant.line) for mutant in sample}) == 20
