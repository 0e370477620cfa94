"""Values that no argument wants, by name, so that a case can be written down and repeated."""

from __future__ import annotations

import atexit
import functools
import math
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

__all__ = ["JSON_VALUES", "RAISING", "USUAL", "VALUES", "insert_odd", "make_pipe", "make_value"]


@functools.cache
def make_pipe() -> Path:
    """Return a pipe that nobody reads or writes; real devices could damage the machine."""
    made = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    os.mkfifo(made / "pipe")
    return made / "pipe"


class _Hostile:
    """Says that it is a sequence, a number and a mapping, and raises when it is asked."""

    def __init__(self, error: type[Exception]) -> None:
        self._error = error

    def _fail(self, *_: object) -> Any:
        raise self._error("hostile")

    __len__ = __iter__ = __getitem__ = __float__ = __int__ = __index__ = __bool__ = __contains__ = (
        _fail
    )
    __eq__ = __lt__ = __le__ = __gt__ = __ge__ = __add__ = __mul__ = __call__ = __fspath__ = (
        __str__
    ) = __repr__ = _fail

    def __hash__(self) -> int:
        return 0


class _Endless:
    """An iterable that never ends, and says that it is short."""

    def __len__(self) -> int:
        return 3

    def __iter__(self) -> Any:
        while True:
            yield 0.0


def _nest(depth: int) -> list[Any]:
    made: list[Any] = []
    for _ in range(depth):
        made = [made]
    return made


def _make_recursive_list() -> list[Any]:
    made: list[Any] = []
    made.append(made)
    return made


def _make_pose(entry: float) -> pin.SE3:
    return pin.SE3(np.full((3, 3), entry), np.full(3, entry))


# What JSON, and so a file, can hold. NaN and infinities are among them: Python's own reader takes
# them.
JSON_VALUES: dict[str, Any] = {
    "None": None,
    "True": True,
    "False": False,
    "-1": -1,
    "0": 0,
    "1": 1,
    "2": 2,
    "7": 7,
    "0.5": 0.5,
    "-0.0": -0.0,
    "1e-300": 1e-300,
    "1e300": 1e300,
    "-1e300": -1e300,
    "1e5": 1e5,
    "10**30": 10**30,
    "nan": math.nan,
    "inf": math.inf,
    "-inf": -math.inf,
    "empty text": "",
    "space": " ",
    "x": "x",
    "long text": "x" * 10000,
    "null byte": "\x00",
    "surrogate": "a\ud800b",
    "escape": "\x1b[2Jé\n",
    "dots": "../../etc",
    "slash": "/",
    "number text": "0.5",
    "comma number": "0,2",
    "a.b": "a.b",
    "door": "door",
    "drawer": "drawer",
    "handle": "handle",
    "slide": "slide",
    "base_x": "base_x",
    "tool0": "tool0",
    "empty list": [],
    "[None]": [None],
    "[0.5]": [0.5],
    "[0, 0]": [0, 0],
    "three": [0.1, 0.2, 0.3],
    "six": [0.1, 0.2, 0.3, 0.0, 0.0, 0.1],
    "nans": [math.nan] * 3,
    "texts": ["x", "y", "z"],
    "ragged": [[1, 2], [3]],
    "many": [0.0] * 20000,
    "nested": _nest(60),
    "empty object": {},
    "object": {"x": 1},
    "object of nan": {"hinge": math.nan},
    "object of lists": {"hinge": [1, 2]},
}

_OTHERS: dict[str, Callable[[], Any]] = {
    "10**5000": lambda: 10**5000,
    "complex": lambda: 1 + 2j,
    "bytes": lambda: b"",
    "bytes 2": lambda: b"door",
    "bytearray": lambda: bytearray(b"\xff\xfe"),
    "tuple": lambda: (),
    "set": lambda: {1, 2},
    "frozenset": lambda: frozenset({"x"}),
    "range": lambda: range(3),
    "generator": lambda: (x for x in (0.0, 1.0, 2.0)),
    "iterator": lambda: iter([1, 2]),
    "function": lambda: lambda *a, **k: None,
    "raising function": lambda: _Hostile(RuntimeError)._fail,
    "type": lambda: int,
    "module": lambda: math,
    "object()": object,
    "Ellipsis": lambda: ...,
    "NotImplemented": lambda: NotImplemented,
    "slice": lambda: slice(3),
    "exception": lambda: ValueError("x"),
    "path": lambda: Path("nowhere/x.yaml"),
    "folder": lambda: Path("/"),
    "pipe": make_pipe,
    "long path": lambda: Path("x" * 10000),
    "null path": lambda: Path("\x00"),
    "surrogate path": lambda: Path("a\ud800b.yaml"),
    "deep": lambda: _nest(5000),
    "itself": _make_recursive_list,
    "dict itself": lambda: (lambda d: d.update(d=d) or d)({}),
    "keys of all kinds": lambda: {None: 1, 1: 2, (): 3, "x": 4},
    "array": lambda: np.zeros(3),
    "array of nan": lambda: np.full(3, np.nan),
    "array of inf": lambda: np.full((2, 3), np.inf),
    "array 0-d": lambda: np.array(0.5),
    "array empty": lambda: np.zeros((0, 3)),
    "array 4x4": lambda: np.eye(4),
    "array 4x4 zeros": lambda: np.zeros((4, 4)),
    "array 3x3x3": lambda: np.zeros((3, 3, 3)),
    "array of objects": lambda: np.array([None, "x", 1.0], object),
    "array of complex": lambda: np.ones(3) * 1j,
    "array of texts": lambda: np.array(["a", "b", "c"]),
    "array of bools": lambda: np.array([True, False, True]),
    "array of dates": lambda: np.array(["2020-01-01"] * 3, "datetime64[D]"),
    "array of records": lambda: np.zeros(3, [("a", float), ("b", int)]),
    "float16": lambda: np.float16(0.5),
    "int64": lambda: np.int64(1),
    "bool_": lambda: np.bool_(True),
    "str_": lambda: np.str_("door"),
    "datetime": lambda: np.datetime64("2020-01-01"),
    "masked": lambda: np.ma.masked,
    "SE3": pin.SE3.Identity,
    "SE3 of nan": lambda: _make_pose(math.nan),
    "SE3 of zeros": lambda: _make_pose(0.0),
    "SE3 of 1e300": lambda: _make_pose(1e300),
    "Quaternion": pin.Quaternion.Identity,
    "Model": pin.Model,
    "GeometryModel": pin.GeometryModel,
    "hostile ValueError": lambda: _Hostile(ValueError),
    "hostile RuntimeError": lambda: _Hostile(RuntimeError),
    "hostile KeyError": lambda: _Hostile(KeyError),
    "endless": _Endless,
    "rng": lambda: np.random.default_rng(0),
}
VALUES: tuple[str, ...] = (*JSON_VALUES, *_OTHERS)
"""The names of all values."""

USUAL = (
    *(
        "None",
        "True",
        "False",
        "0",
        "1",
        "2",
        "7",
        "0.5",
        "1e-300",
        "-0.0",
        "three",
        "six",
        "[0.5]",
        "empty list",
        "empty object",
    ),
    *(
        "x",
        "door",
        "drawer",
        "handle",
        "slide",
        "base_x",
        "tool0",
        "array",
        "array 4x4",
        "array 0-d",
        "float16",
        "int64",
        "SE3",
    ),
)
"""Names of those that some argument may take."""
RAISING = (
    "raising function",
    "type",
    "hostile ValueError",
    "hostile RuntimeError",
    "hostile KeyError",
)
"""Names of callables that raise errors."""


def make_value(name: str) -> Any:
    """Return a new value by its name."""
    if name in _OTHERS:
        return _OTHERS[name]()
    found = JSON_VALUES[name]
    return type(found)(found) if isinstance(found, list | dict) else found


def insert_odd(given: Any, odd: Any, at: int) -> Any:
    """Return a copy of a list or dictionary with one odd entry, or `odd` itself if it is empty."""
    if isinstance(given, dict) and given:
        keys = list(given)
        key = keys[at % len(keys)]
        if at % 3 == 0 and isinstance(odd, str | int | float | tuple | None):
            return {**given, odd: given[key]}
        return {**given, key: odd}
    if isinstance(given, list | tuple) and len(given):
        copy = list(given)
        copy[at % len(copy)] = odd
        return copy
    if isinstance(given, np.ndarray) and given.ndim:
        copy = given.tolist()
        copy[at % len(copy)] = odd
        return copy
    return odd
