"""The exceptions of the package; all of them derive from `VkcError` and carry data, not only text."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from pathlib import Path

__all__ = ["BuildError", "InputError", "UnknownNameError", "VkcError", "nearest_name"]


def nearest_name(name: str, choices: Iterable[str]) -> str | None:
    """Return the choice that resembles `name` most, or None if none does."""
    matches = difflib.get_close_matches(str(name), [str(c) for c in choices], n=1, cutoff=0.5)
    return matches[0] if matches else None


class VkcError(Exception):
    """Base class of every error this package raises on purpose."""


class BuildError(VkcError):
    """The compiled part of the package is missing or does not fit what is installed."""


class InputError(VkcError, ValueError):
    """Bad input: says where it stands, what was expected and what came.

    Attributes:
        problem: What is wrong, in one sentence.
        file: The file it stands in, if any.
        line: The line in that file, counted from 1, if known.
        field: The field or argument, e.g. `obstacles[3].size`.
        expected: What would have been right.
        got: What came instead.
    """

    def __init__(
        self,
        problem: str,
        *,
        file: str | Path | None = None,
        line: int | None = None,
        field: str | None = None,
        expected: object = None,
        got: object = None,
    ) -> None:
        self.problem, self.file, self.line, self.field = problem, file, line, field
        self.expected, self.got = expected, got
        where = "" if file is None else f"{file}:{line}: " if line is not None else f"{file}: "
        what = problem if field is None else f"{field}: {problem}"
        details = [f"{label} {value}" for label, value in (("expected", expected), ("got", got)) if value is not None]
        super().__init__(where + what + (f" ({', '.join(details)})" if details else ""))


class UnknownNameError(InputError):
    """A name of some `kind` that does not exist; `choices` are those that do, `nearest` the one that resembles it most."""

    def __init__(
        self,
        kind: str,
        name: str,
        choices: Iterable[str],
        *,
        file: str | Path | None = None,
        line: int | None = None,
        field: str | None = None,
    ) -> None:
        self.kind, self.name, self.choices = kind, name, tuple(str(c) for c in choices)
        self.nearest = nearest_name(name, self.choices)
        listed = ", ".join(self.choices[:12]) + (", ..." if len(self.choices) > 12 else "")
        hint = f"; did you mean '{self.nearest}'?" if self.nearest else ""
        problem = f"there is no {kind} '{name}'{hint} There are: {listed or 'none'}"
        super().__init__(problem if hint else problem.replace(" There are", "; there are", 1), file=file, line=line, field=field)
