"""Provides strategies for values of all types, most of them invalid as an argument."""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays


class Hostile:
    """Claims to be a sequence, a number and a mapping, but raises an error on every use."""

    def _fail(self, *_: object) -> Any:
        raise RuntimeError("hostile")

    __len__ = __iter__ = __getitem__ = __float__ = __int__ = __index__ = __bool__ = _fail
    __eq__ = __lt__ = __le__ = __gt__ = __ge__ = __add__ = __mul__ = __call__ = _fail
    __contains__ = __fspath__ = __str__ = __repr__ = _fail

    def __hash__(self) -> int:
        return 0


class Endless:
    """An endless iterable that claims to have three entries."""

    def __len__(self) -> int:
        return 3

    def __iter__(self) -> Any:
        while True:
            yield 0.0


def nest(depth: int) -> list[Any]:
    """Return lists in each other."""
    nested: list[Any] = []
    for _ in range(depth):
        nested = [nested]
    return nested


def make_pose(entry: float) -> pin.SE3:
    """Return a placement whose entries are all the same."""
    return pin.SE3(np.full((3, 3), entry), np.full(3, entry))


NAMES = ("x", "door", "drawer", "handle", "slide", "hinge", "base_x", "tool0", "name", "type")
ODD_TEXTS = (
    "",
    " ",
    "0.5",
    "0,2",
    "a.b",
    "../../etc",
    "/",
    "\x00",
    "a\ud800b",
    "\x1b[2J",
    "x" * 10_000,
)
TEXTS = st.sampled_from(NAMES) | st.sampled_from(ODD_TEXTS) | st.text()
NUMBERS = (
    st.sampled_from((0, 1, 2, 7, 0.5, 1e5, 1e300, 10**30, math.nan)) | st.integers() | st.floats()
)
# Copied, since a second change may change the value of the first one.
LISTS = st.sampled_from(
    ([0.1, 0.2, 0.3], [0.1, 0.2, 0.3, 0.0, 0.0, 0.1], [[1, 2], [3]], [0.0] * 20_000, nest(60))
).map(copy.deepcopy)
JSON = st.recursive(
    st.none() | st.booleans() | NUMBERS | TEXTS | LISTS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXTS, inner, max_size=3),
    max_leaves=6,
)
"""Values that a JSON file can contain, and NaN and infinities, which Python's parser accepts."""

ARRAYS = arrays.arrays(
    arrays.scalar_dtypes() | st.sampled_from((object, "U3")),
    arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
)
PATHS = st.sampled_from(("nowhere/x.yaml", "/", "x" * 10_000, "\x00", "a\ud800b.yaml")).map(Path)
POSES = st.sampled_from((math.nan, 0.0, 1e300)).map(make_pose) | st.builds(pin.SE3.Identity)
OTHERS = st.one_of(
    st.sampled_from((10**5000, int, math, ..., NotImplemented, range(3), np.ma.masked)),
    st.sampled_from(({1, 2}, frozenset("x"), (), bytearray(b"\xff"), {None: 1})).map(copy.copy),
    st.sampled_from((np.float16(0.5), np.int64(1), np.bool_(True), np.str_("door"))),
    st.complex_numbers() | st.binary() | st.datetimes(),
    st.functions(like=lambda *_, **__: None, returns=NUMBERS) | st.builds(iter, st.lists(NUMBERS)),
    st.builds(pin.Model) | st.builds(pin.GeometryModel) | st.builds(pin.Quaternion.Identity),
    st.builds(Hostile) | st.builds(Endless) | st.builds(object),
    st.builds(np.random.default_rng, st.just(0)),
)
VALUES = st.one_of(JSON, JSON, ARRAYS, PATHS, POSES, OTHERS)
"""Values of all types."""
