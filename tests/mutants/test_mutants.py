"""The faults that `python -m tests.mutants` makes; the runs themselves take too long for tests."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from . import __main__
from .__main__ import drawn
from .mutations import mutants
from .running import Coverage

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
    return {mutant.what for mutant in mutants("x.py", SOURCE)}


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
def test_each_kind_of_fault_is_made(what: str) -> None:
    assert what in made()


def test_a_fault_is_one_change_of_a_source_that_can_be_read() -> None:
    for mutant in mutants("x.py", SOURCE):
        assert ast.dump(ast.parse(mutant.source)) != ast.dump(ast.parse(SOURCE))
        before, after = SOURCE.splitlines(), mutant.source.splitlines()
        assert [
            k for k, (one, other) in enumerate(zip(before, after, strict=True), 1) if one != other
        ] == [mutant.line]
        assert mutant.at == before[mutant.line - 1].strip()


def test_texts_types_and_what_is_raised_are_left_alone() -> None:
    changed = {mutant.line for mutant in mutants("x.py", SOURCE)}
    lines = SOURCE.splitlines()
    assert not {
        k
        for k in changed
        if any(
            word in lines[k - 1]
            for word in ("Docstring", "__all__", "raise", "detail =", "Return 1")
        )
    }


def test_who_is_asked_about_a_constant() -> None:
    """Of one of the module, those that execute the lines that use it; of a class's field, nobody in particular."""
    where = {mutant.what: (mutant.line, mutant.lines) for mutant in mutants("x.py", SOURCE)}
    assert where["constant: 5.0 → 10.0"] == (3, (16,))
    assert where["constant: 2 → 3"] == (7, ())
    assert where["name: min → max"] == (16, (16,))


def test_what_is_written_elsewhere_changes_no_other_draw(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(__main__, "PACKAGE", tmp_path)
    (tmp_path / "x.py").write_text(SOURCE)
    before = [mutant.name for mutant in drawn(["x.py"], 100, 1)]
    (tmp_path / "x.py").write_text(
        SOURCE.replace("class Kept", "MOST = 7\n\n\nclass Kept").replace(
            "        self.count += 1\n", ""
        )
    )
    after = [mutant.name for mutant in drawn(["x.py"], 100, 1)]
    assert [name for name in after if "MOST" not in name] == [
        name for name in before if "self.count" not in name
    ]
    assert before != [mutant.name for mutant in drawn(["x.py"], 100, 2)]


def test_same_faults_are_known_apart() -> None:
    source = "def both(a, b):\n    a += b\n    b += 1\n    a += b\n    return a\n"
    names = [mutant.name for mutant in mutants("x.py", source)]
    assert len(set(names)) == len(names) == 4
    assert [mutant.again for mutant in mutants("x.py", source) if mutant.at == "a += b"] == [0, 1]


def test_a_modules_own_files_are_asked_first_and_quick_ones_before_slow_ones() -> None:
    seconds = {
        "tests/wing/test_x.py::slow": 9.0,
        "tests/wing/test_x_line.py::b": 0.2,
        "tests/wing/test_x_line.py::a": 0.1,
        "tests/wing/test_xy.py::other": 0.01,
        "tests/other/test_x.py::far": 0.02,
    }
    mutant = next(iter(mutants("wing/x.py", "def f(a):\n    return a + 1\n")))
    known = Coverage(seconds, {"wing/x.py:2": list(seconds)})
    own = [
        "tests/wing/test_x_line.py::a",
        "tests/wing/test_x_line.py::b",
        "tests/wing/test_x.py::slow",
    ]
    assert known.tests_of(mutant, 100.0) == [
        *own,
        "tests/wing/test_xy.py::other",
        "tests/other/test_x.py::far",
    ]
    assert known.tests_of(mutant, 5.0) == own[:2]
