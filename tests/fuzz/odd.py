"""Makes invalid values by name, so that cases can be saved and repeated."""

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

__all__ = ["JSON_VALUES", "RAISING", "USUAL", "VALUES", "insert_value", "make_pipe", "make_value"]


@functools.cache
def make_pipe() -> Path:
    """Return a pipe that nobody reads or writes; real devices could damage the machine."""
    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.mkfifo(folder / "pipe")
    return folder / "pipe"


class _Hostile:
    """Claims to be a sequence, a number and a mapping, but raises an error on every use."""

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
    """An endless iterable that claims to have three entries."""

    def __len__(self) -> int:
        return 3

    def __iter__(self) -> Any:
        while True:
            yield 0.0


def _nest(depth: int) -> list[Any]:
    nested: list[Any] = []
    for _ in range(depth):
        nested = [nested]
    return nested


def _make_recursive_list() -> list[Any]:
    values: list[Any] = []
    values.append(values)
    return values


def _make_pose(entry: float) -> pin.SE3:
    return pin.SE3(np.full((3, 3), entry), np.full(3, entry))


# Values that a JSON file can contain, including NaN and infinities, which Python's parser accepts.
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
"""Names of all values."""

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
"""Names of values that are valid for some argument."""
RAISING = (
    "raising function",
    "type",
    "hostile ValueError",
    "hostile RuntimeError",
    "hostile KeyError",
)
"""Names of callables that raise errors."""


def make_value(name: str) -> Any:
    """Return a new copy of a named value."""
    if name in _OTHERS:
        return _OTHERS[name]()
    value = JSON_VALUES[name]
    return type(value)(value) if isinstance(value, list | dict) else value


def insert_value(container: Any, value: Any, index: int) -> Any:
    """Return a copy of a container with one entry replaced, or `value` if there is none."""
    if isinstance(container, dict) and container:
        keys = list(container)
        key = keys[index % len(keys)]
        if index % 3 == 0 and isinstance(value, str | int | float | tuple | None):
            return {**container, value: container[key]}
        return {**container, key: value}
    if isinstance(container, list | tuple) and len(container):
        copy = list(container)
        copy[index % len(copy)] = value
        return copy
    if isinstance(container, np.ndarray) and container.ndim:
        copy = container.tolist()
        copy[index % len(copy)] = value
        return copy
    return value
