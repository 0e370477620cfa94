"""Checks arguments of public functions, and raises `InputError` with the name of the argument.

The checks test the type of a value first and ask values of other types for nothing: their `len`,
`float` or comparisons may do anything.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterator, KeysView, Mapping, Sequence, ValuesView
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numpy as np

from vkc_pin.errors import InputError, UnknownNameError, format_value
from vkc_pin.utils.arrays import MAX_COORDINATE, Floats

T = TypeVar("T")
MAX_ENTRIES = 100_000
"""Largest number of entries of a list."""


def _fail(problem: str, field: str, expected: str, value: Any) -> NoReturn:
    raise InputError(problem, field=field, expected=expected, got=format_value(value)) from None


def _add_article(noun: str) -> str:
    return f"{'an' if noun[0] in 'AEIOaeio' else 'a'} {noun}"


def is_number(value: object) -> bool:
    """Return whether a value is a real number of Python or NumPy, including NaN but no booleans."""
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
        value: The argument.
        field: Its name.
        expected: Valid values, for the message.
        low: Smallest valid number.
        high: Largest valid number.
        strict: Exclude `low` itself.
    """
    if isinstance(value, np.ndarray) and value.ndim == 0 and value.dtype.kind in "iuf":
        value = value.item()
    is_bounded = low > -math.inf
    if not is_number(value):
        _fail("out of range" if is_bounded else "not a number", field, expected, value)
    try:
        found = float(value)
    except OverflowError:
        found = math.inf
    if not (math.isfinite(found) and low <= found <= high) or (strict and found == low):
        _fail("out of range" if is_bounded else "not finite", field, expected, value)
    return found


def check_coordinate(value: Any, field: str) -> float:
    """Return a length [m] or angle [rad] of magnitude up to `MAX_COORDINATE`."""
    expected = f"a number from {-MAX_COORDINATE:g} to {MAX_COORDINATE:g}"
    found = check_number(value, field, expected)
    if abs(found) > MAX_COORDINATE:
        _fail("out of range", field, expected, value)
    return found


def check_integer(value: Any, field: str, *, low: int, high: int = 2**63 - 1) -> int:
    """Return an integer from `low` to `high`."""
    is_integer = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not is_integer or not low <= value <= high:
        has_bound = high < 2**63 - 1 or (is_integer and value > high)
        bounds = f"from {low} to {high}" if has_bound else f"of at least {low}"
        _fail("out of range", field, f"a whole number {bounds}", value)
    return int(value)


def check_array(
    value: Any, field: str, expected: str = "an array of numbers", *, problem: str = "not numbers"
) -> Floats:
    """Return a copy of an array of real numbers, of any shape; they may be infinite or NaN.

    Args:
        value: A number, a list, nested lists, or an array.
        field: Name of the argument.
        expected: Valid values, for the message.
        problem: Problem with other values, for the message.
    """
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, OverflowError, RecursionError):  # ragged or deeply nested lists
        _fail(problem, field, expected, value)
    if array.dtype.kind not in "iuf" and array.size:
        _fail(problem, field, expected, value)
    return np.array(array, float) if array.size else np.zeros(array.shape)


def check_finite_array(value: Any, field: str, file: str | Path | None = None) -> Floats:
    """Return a copy of an array of finite numbers; see `check_array`."""
    array = check_array(value, field)
    if not np.isfinite(array).all():
        where = np.argwhere(~np.isfinite(array))[0].tolist()
        raise InputError(
            "not finite",
            file=file,
            field=f"{field}{where or ''}",
            expected="finite numbers",
            got=array[tuple(where)],
        )
    return array


def check_text(value: Any, field: str, expected: str = "text") -> str:
    """Return text that UTF-8 can encode: half of a surrogate pair cannot be written to a file."""
    try:
        if isinstance(value, str):
            value.encode("utf-8")
            return str(value)
    except UnicodeEncodeError:
        pass
    _fail("not text", field, expected, value)


def check_bool(value: Any, field: str) -> bool:
    """Return True or False; raise `InputError` for other values."""
    if not isinstance(value, bool | np.bool_):
        _fail("neither true nor false", field, "True or False", value)
    return bool(value)


def check_choice(value: Any, choices: Collection[str], kind: str, field: str | None = None) -> str:
    """Return a name that is one of `choices`, the names of a `kind`."""
    name = check_text(value, field or kind, f"the name of {_add_article(kind)}")
    if name not in choices:
        raise UnknownNameError(kind, name, choices, field=field)
    return name


def check_instance(
    value: Any, kind: type[T] | tuple[type[T], ...], field: str, expected: str | None = None
) -> T:
    """Return an instance of a type, or of one of several; raise `InputError` for other values."""
    if not isinstance(value, kind):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        name = " or ".join(one.__name__ for one in kinds)
        _fail("wrong type of argument", field, expected or _add_article(name), value)
    return value


def check_mapping(
    value: Any, field: str, expected: str = "names, each with its value"
) -> dict[str, Any]:
    """Return a dictionary whose keys are text; raise `InputError` for other values."""
    if not isinstance(value, Mapping):
        _fail("wrong type of argument", field, f"a dictionary: {expected}", value)
    return {check_text(name, f"{field}: a name in it"): entry for name, entry in value.items()}


def check_list(
    value: Any, field: str, expected: str, kind: type[T] | tuple[type[T], ...] | None = None
) -> tuple[T, ...]:
    """Return the entries of a list, tuple, array, or iterator of at most `MAX_ENTRIES` entries.

    Args:
        value: The argument.
        field: Its name.
        expected: Valid values, for the message.
        kind: Type of its entries. Default: any.
    """
    is_list = isinstance(value, Sequence | Iterator | KeysView | ValuesView) and not isinstance(
        value, str | bytes | bytearray
    )
    if not is_list and not (isinstance(value, np.ndarray) and value.ndim):
        _fail("not a list", field, expected, value)
    found = tuple(itertools.islice(value, MAX_ENTRIES + 1))
    if len(found) > MAX_ENTRIES:
        expected = f"at most {MAX_ENTRIES}"
        raise InputError("too many entries", field=field, expected=expected, got="more")
    for index, entry in enumerate(found):
        if kind is not None and not isinstance(entry, kind):
            _fail("wrong type of entry", f"{field}[{index}]", expected, entry)
    return found
