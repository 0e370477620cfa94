"""Checks of what callers hand over: what is not of the right kind becomes an `InputError` that names the argument.

Everything public looks at its arguments with these before it uses them. They ask for the kind of a
value first, and nothing of a value of another kind: what it would answer to `len`, `float` or a
comparison is anybody's guess.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterator, KeysView, Mapping, Sequence, ValuesView
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from vkc_pin.errors import InputError, UnknownNameError, format_value
from vkc_pin.utils.arrays import MAX_COORDINATE, Floats

__all__ = [
    "check_array",
    "check_bool",
    "check_choice",
    "check_coordinate",
    "check_finite_array",
    "check_instance",
    "check_integer",
    "check_list",
    "check_mapping",
    "check_number",
    "check_text",
    "is_number",
]

T = TypeVar("T")
MAX_ENTRIES = 100_000
"""Most entries of a list that an argument may be."""


def is_number(value: object) -> bool:
    """Return whether a value is a real number, of Python or NumPy; True and False are none, and NaN is one."""
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def check_number(
    value: Any,
    field: str,
    expected: str = "a finite number",
    *,
    low: float = -math.inf,
    high: float = math.inf,
    strict: bool = False,
) -> float:
    """Return a finite number.

    Args:
        value: What was given.
        field: The argument's name.
        expected: What would be right, for the message.
        low: The lowest that will do.
        high: The highest that will do.
        strict: Whether it must be more than `low`.

    Raises:
        InputError: It is none, not finite, too low or too high.
    """
    if isinstance(value, np.ndarray) and value.ndim == 0 and value.dtype.kind in "iuf":
        value = value.item()
    if not is_number(value):
        problem = "not a number" if low == -math.inf else "out of range"
        raise InputError(problem, field=field, expected=expected, got=format_value(value))
    try:
        found = float(value)
    except OverflowError:
        found = math.inf
    if not (math.isfinite(found) and low <= found <= high) or (strict and found == low):
        problem = "not finite" if low == -math.inf else "out of range"
        raise InputError(problem, field=field, expected=expected, got=format_value(value))
    return found


def check_coordinate(value: Any, field: str) -> float:
    """Return a length [m] or an angle [rad] of at most `LARGEST`, either way. Raises `InputError` if it is none."""
    expected = f"a number from {-MAX_COORDINATE:g} to {MAX_COORDINATE:g}"
    found = check_number(value, field, expected)
    if abs(found) > MAX_COORDINATE:
        raise InputError("out of range", field=field, expected=expected, got=format_value(value))
    return found


def check_integer(value: Any, field: str, *, low: int, high: int = 2**63 - 1) -> int:
    """Return a whole number from `low` to `high`. Raises `InputError` if it is none."""
    if (
        not isinstance(value, int | np.integer)
        or isinstance(value, bool)
        or not low <= value <= high
    ):
        expected = (
            f"a whole number of at least {low}"
            if high == 2**63 - 1
            else f"a whole number from {low} to {high}"
        )
        raise InputError("out of range", field=field, expected=expected, got=format_value(value))
    return int(value)


def check_array(
    value: Any, field: str, expected: str = "an array of numbers", *, problem: str = "not numbers"
) -> Floats:
    """Return a copy of an array of numbers, of any shape and not looked at further.

    Args:
        value: A number, a list, of lists if need be, or an array.
        field: The argument's name.
        expected: What would be right, for the message.
        problem: What is wrong otherwise, for the message.

    Raises:
        InputError: It is none, or has entries that are no real numbers.
    """
    try:
        array = np.asarray(value)
    except (
        TypeError,
        ValueError,
        OverflowError,
        RecursionError,
    ):  # lists of unequal lengths, or too deep
        raise InputError(problem, field=field, expected=expected, got=format_value(value)) from None
    if array.dtype.kind not in "iuf" and array.size:
        raise InputError(problem, field=field, expected=expected, got=format_value(value))
    return np.array(array, float) if array.size else np.zeros(array.shape)


def check_finite_array(value: Any, field: str, file: str | Path | None = None) -> Floats:
    """Return a copy of an array of numbers, as `numbers` does, that are all finite.

    Raises:
        InputError: As `numbers`; or a number is not finite, with its place in the array.
    """
    array = check_array(value, field)
    if not np.isfinite(array).all():
        where = np.argwhere(~np.isfinite(array))[0].tolist()
        got = array[tuple(where)]
        raise InputError(
            "not finite",
            file=file,
            field=f"{field}{where or ''}",
            expected="finite numbers",
            got=got,
        )
    return array


def check_text(value: Any, field: str, expected: str = "text") -> str:
    """Return a text. Raises `InputError` if it is none."""
    if not isinstance(value, str) or not _is_utf8(value):
        raise InputError("not text", field=field, expected=expected, got=format_value(value))
    return str(value)


def _is_utf8(value: str) -> bool:
    """Return whether a text can be written into a file: halves of surrogate pairs cannot."""
    try:
        value.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return True


def check_bool(value: Any, field: str) -> bool:
    """Return True or False. Raises `InputError` if it is neither."""
    if not isinstance(value, bool | np.bool_):
        raise InputError(
            "neither true nor false", field=field, expected="True or False", got=format_value(value)
        )
    return bool(value)


def check_choice(value: Any, choices: Collection[str], kind: str, field: str | None = None) -> str:
    """Return a name that is one of `choices`, which are of some `kind`.

    Raises:
        InputError: It is no text.
        UnknownNameError: It is none of them.
    """
    name = check_text(value, field or kind, f"the name of a {kind}")
    if name not in choices:
        raise UnknownNameError(kind, name, choices, field=field)
    return name


def check_instance(
    value: Any, kind: type[T] | tuple[type[T], ...], field: str, expected: str | None = None
) -> T:
    """Return a value that is of some kind. Raises `InputError` if it is not."""
    if not isinstance(value, kind):
        name = (
            kind.__name__ if isinstance(kind, type) else " or ".join(one.__name__ for one in kind)
        )
        raise InputError(
            "wrong type of argument",
            field=field,
            expected=expected or f"a {name}",
            got=format_value(value),
        )
    return value


def check_mapping(
    value: Any, field: str, expected: str = "names, each with its value"
) -> dict[str, Any]:
    """Return a dictionary whose keys are texts. Raises `InputError` if it is none."""
    if not isinstance(value, Mapping):
        raise InputError(
            "wrong type of argument",
            field=field,
            expected=f"a dictionary: {expected}",
            got=format_value(value),
        )
    return {check_text(name, f"{field}: a name in it"): entry for name, entry in value.items()}


def check_list(
    value: Any, field: str, expected: str, kind: type[T] | tuple[type[T], ...] | None = None
) -> tuple[T, ...]:
    """Return a list as a tuple, its entries of some kind if one is given.

    Args:
        value: A list, a tuple, an array, or an iterator that ends before `MOST` entries.
        field: The argument's name.
        expected: What would be right, for the message.
        kind: What its entries must be.

    Raises:
        InputError: It is no list, or an entry is of another kind.
    """
    listed = isinstance(value, Sequence | Iterator | KeysView | ValuesView) and not isinstance(
        value, str | bytes | bytearray
    )
    if not listed and not (isinstance(value, np.ndarray) and value.ndim):
        raise InputError("not a list", field=field, expected=expected, got=format_value(value))
    found = tuple(itertools.islice(value, MAX_ENTRIES + 1))
    if len(found) > MAX_ENTRIES:
        raise InputError(
            "too many entries", field=field, expected=f"at most {MAX_ENTRIES}", got="more"
        )
    for place, entry in enumerate(found):
        if kind is not None and not isinstance(entry, kind):
            raise InputError(
                "wrong type of entry",
                field=f"{field}[{place}]",
                expected=expected,
                got=format_value(entry),
            )
    return found
