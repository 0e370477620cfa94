"""Defines the exceptions of the package, which carry data as well as text."""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

_MAX_VALUE_LENGTH = 300  # characters of a value in a message
_MAX_NAME_LENGTH = 80


class _ShortRepr(reprlib.Repr):
    def repr_float64(self, x: float, level: int) -> str:
        return repr(float(x))  # NumPy's numbers as Python's

    def repr_int(self, x: int, level: int) -> str:
        bits = x.bit_length()  # Python refuses to write out very large ones
        return repr(x) if bits <= 256 else f"an integer of {bits} bits"


_SHORT_REPR = _ShortRepr()
_SHORT_REPR.maxlevel = 5
_SHORT_REPR.maxtuple = 12
_SHORT_REPR.maxlist = 12
_SHORT_REPR.maxdict = 8
_SHORT_REPR.maxset = 8
_SHORT_REPR.maxstring = _SHORT_REPR.maxother = 200


def format_value(value: object) -> str:
    """Return the `repr` of a value, shortened in length and depth, without its exceptions."""
    return _SHORT_REPR.repr(value)


def _shorten(text: str, most: int = _MAX_VALUE_LENGTH) -> str:
    return text if len(text) <= most else f"{text[: most - 43]}...{text[-40:]}"


def _escape(text: str) -> str:
    """Replace what terminals would execute or cannot print by Python's escapes."""
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)


def _format_detail(value: object) -> str:
    if isinstance(value, float | Path):
        return _shorten(str(value))
    return _shorten(value if isinstance(value, str) else format_value(value))


def _shorten_name(name: str) -> str:
    return _escape(_shorten(name, _MAX_NAME_LENGTH))


def find_nearest_name(name: str, choices: Iterable[str]) -> str | None:
    """Return the choice most similar to `name`, or None if none is similar."""
    matches = difflib.get_close_matches(
        _shorten(name, _MAX_NAME_LENGTH), [str(c) for c in choices], n=1, cutoff=0.5
    )
    return matches[0] if matches else None


class VkcError(Exception):
    """Base class of the errors of this package. All can be pickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the attributes: by default, Python would call the class with the message."""
        plain = str, int, float, bool, Path, type(None)
        state = {
            name: value if isinstance(value, plain) or name == "choices" else _format_detail(value)
            for name, value in vars(self).items()
        }
        return _restore_error, (type(self), self.args, state)


def _restore_error(kind: type[VkcError], texts: tuple[Any, ...], state: dict[str, Any]) -> VkcError:
    error = kind.__new__(kind, *texts)
    error.__dict__.update(state)
    return error


class BuildError(VkcError):
    """The compiled part is missing, or does not fit the installed packages."""


class InputError(VkcError, ValueError):
    """Invalid input, with its place, the expected values and the given one.

    Attributes:
        problem: The problem in one sentence.
        file: File of the input, if any.
        line: Line in that file, counted from 1, if known.
        field: Field or argument, such as `obstacles[3].size`.
        expected: Valid values.
        got: The given value.
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
        named = None if file is None else _escape(_shorten(str(file)))
        where = "" if named is None else f"{named}:{line}: " if line is not None else f"{named}: "
        what = problem if field is None else f"{_escape(_shorten(field))}: {problem}"
        details = [
            f"{label} {_format_detail(value)}"
            for label, value in (("expected", expected), ("got", got))
            if value is not None
        ]
        super().__init__(
            _shorten(where + what, 6 * _MAX_VALUE_LENGTH)
            + (f" ({', '.join(details)})" if details else "")
        )


class UnknownNameError(InputError):
    """A name of some `kind` that does not exist, with all `choices` and the `nearest`."""

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
        self.nearest = find_nearest_name(name, self.choices)
        listed = ", ".join(_shorten_name(choice) for choice in self.choices[:12]) + (
            ", ..." if len(self.choices) > 12 else ""
        )
        hint = f"; did you mean '{_shorten_name(self.nearest)}'?" if self.nearest else ""
        problem = f"there is no {kind} '{_shorten_name(name)}'"
        known = f"here are: {listed or 'none'}"
        super().__init__(
            f"{problem}{hint} T{known}" if hint else f"{problem}; t{known}",
            file=file,
            line=line,
            field=field,
        )
