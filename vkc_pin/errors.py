"""Defines the exceptions of the package, which carry data as well as text."""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

_MAX_VALUE_LENGTH = 300  # characters of a value in a message
_MAX_NAME_LENGTH = 80
_MAX_MESSAGE_LENGTH = 6 * _MAX_VALUE_LENGTH  # without the expected and the given value
_MAX_LISTED_CHOICES = 12


class _ShortRepr(reprlib.Repr):
    def repr_float64(self, x: float, level: int) -> str:
        return repr(float(x))  # NumPy's numbers as Python's

    def repr_int(self, x: int, level: int) -> str:
        # Python refuses to write out very large integers.
        bits = x.bit_length()
        return repr(x) if bits <= 256 else f"an integer of {bits} bits"


_SHORT_REPR = _ShortRepr()
_SHORT_REPR.maxlevel = 5
_SHORT_REPR.maxtuple = 12
_SHORT_REPR.maxlist = 12
_SHORT_REPR.maxdict = 8
_SHORT_REPR.maxset = 8
_SHORT_REPR.maxstring = 200
_SHORT_REPR.maxother = 200


def format_value(value: object) -> str:
    """Return the `repr` of a value, shortened in length and depth, without its exceptions."""
    return _SHORT_REPR.repr(value)


def _shorten(text: str, max_length: int = _MAX_VALUE_LENGTH) -> str:
    """Return the start and the last 40 characters of a text that is longer than `max_length`."""
    if len(text) <= max_length:
        return text
    start = text[: max_length - 43]
    end = text[-40:]
    return f"{start}...{end}"


def _escape(text: str) -> str:
    """Replace characters that terminals would execute or cannot print by Python's escapes."""
    letters = list[str]()
    for letter in text:
        letters.append(letter if letter.isprintable() else ascii(letter)[1:-1])
    return "".join(letters)


def _format_detail(value: object) -> str:
    if isinstance(value, str | float | Path):
        return _shorten(str(value))
    return _shorten(format_value(value))


def _shorten_name(name: str) -> str:
    return _escape(_shorten(name, _MAX_NAME_LENGTH))


def find_nearest_name(name: str, choices: Iterable[str]) -> str | None:
    """Return the choice most similar to `name`, or None if none is similar."""
    short_name = _shorten(name, _MAX_NAME_LENGTH)
    texts = [str(choice) for choice in choices]
    matches = difflib.get_close_matches(short_name, texts, n=1, cutoff=0.5)
    return matches[0] if matches else None


class VkcError(Exception):
    """Base class of the errors of this package. All can be pickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the attributes: by default, Python would call the class with the message."""
        plain = (str, int, float, bool, Path, type(None))
        state = dict(vars(self))
        for name, value in vars(self).items():
            if name != "choices" and not isinstance(value, plain):
                state[name] = _format_detail(value)
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
        self.problem = problem
        self.file = file
        self.line = line
        self.field = field
        self.expected = expected
        self.got = got
        super().__init__(self._format())

    def _format(self) -> str:
        """Return the message: "file:line: field: problem (expected ..., got ...)"."""
        text = ""
        if self.file is not None:
            text += _escape(_shorten(str(self.file)))
            text += ": " if self.line is None else f":{self.line}: "
        if self.field is not None:
            text += f"{_escape(_shorten(self.field))}: "
        text = _shorten(text + self.problem, _MAX_MESSAGE_LENGTH)
        details = list[str]()
        if self.expected is not None:
            details.append(f"expected {_format_detail(self.expected)}")
        if self.got is not None:
            details.append(f"got {_format_detail(self.got)}")
        return f"{text} ({', '.join(details)})" if details else text


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
        self.kind = kind
        self.name = name
        self.choices = tuple(str(choice) for choice in choices)
        self.nearest = find_nearest_name(name, self.choices)
        listed = [_shorten_name(choice) for choice in self.choices[:_MAX_LISTED_CHOICES]]
        if len(self.choices) > _MAX_LISTED_CHOICES:
            listed.append("...")
        known = ", ".join(listed) or "none"
        problem = f"there is no {kind} '{_shorten_name(name)}'"
        if self.nearest:
            problem += f"; did you mean '{_shorten_name(self.nearest)}'? There are: {known}"
        else:
            problem += f"; there are: {known}"
        super().__init__(problem, file=file, line=line, field=field)
