"""Provides strategies for changed copies of files' contents and of plain data."""

from __future__ import annotations

import copy
import functools
import operator
import re
from collections.abc import Iterator
from typing import Any

from hypothesis import strategies as st

from .values import JSON, TEXTS

MAX_BYTES = 2_000_000
PLAUSIBLE = st.sampled_from((st.floats(-3.0, 3.0), st.floats(0.0, 0.1))).flatmap(
    lambda numbers: numbers.map(lambda number: b"%g" % number)
)
NUMBERS = st.sampled_from(
    [*b"nan inf -inf 1e300 1e-300 -1 0 1e5 0,2 0x10 1_0 true".split(), b"9" * 400, b""]
)
WORDS = st.sampled_from(
    [*b"null ~ yes !!python/object:os.system &a *a ? { [ < &amp; .. /".split(), b"", b"- "]
)
TAGS = st.sampled_from((b"", b"<x>", b"</x>", b"<link/>", b"<joint/>", b"<mesh/>"))
NUMBER = re.compile(rb"-?\d+\.?\d*(?:e-?\d+)?")
TOKENS = (
    *[(NUMBER, NUMBERS)] * 4,
    *[(NUMBER, PLAUSIBLE)] * 2,
    *[(re.compile(rb"[A-Za-z_][\w.]*"), WORDS)] * 2,
    *[(re.compile(rb"</?[A-Za-z_][^<>]*>"), TAGS)] * 2,
    (re.compile(rb"\s[\w:]+=\"[^\"]*\""), st.just(b"")),
    (re.compile(rb"^.*\n", re.MULTILINE), st.sampled_from((b"", b"  ", b"- "))),
)
"""Patterns of tokens and what replaces them, if it is not another token of the same pattern."""
RECODED = (
    lambda data: data.decode("latin-1").encode("utf-16"),
    lambda data: data.decode("latin-1").encode("utf-32"),
    lambda data: b"\xef\xbb\xbf" + data,
    lambda data: data.replace(b"\n", b"\r"),
    lambda data: data.replace(b"\n", b"\x00"),
    lambda data: data.replace(b" ", b"\t"),
    lambda data: b"\x00" * len(data),
    lambda data: b"",
    lambda data: data.upper(),
    lambda data: data * 20,
    lambda data: b"---\n" + data + b"\n---\n" + data,
    lambda data: b"- " * 5000 + data,
    lambda data: b"[" * 20_000,
    lambda data: b"{a: " * 3000,
    lambda data: b"<robot name='x'>" * 3000,
    lambda data: b'<!DOCTYPE r [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;">]><robot name="&b;"/>',
    lambda data: b"a: &a [x, x]\nb: &b [*a, *a]\nc: &c [*b, *b]\n" + data,
)


@st.composite
def change_bytes(draw: st.DrawFn, data: bytes) -> bytes:
    """Return the content of a file with one to three changes."""
    changes = (*[_change_token] * 8, *[_change_span] * 2, _truncate, _overwrite, _recode)
    for _ in range(draw(st.integers(1, 3))):
        data = draw(st.sampled_from(changes))(draw, data)[:MAX_BYTES]
    return data


def _change_token(draw: st.DrawFn, data: bytes) -> bytes:
    pattern, others = draw(st.sampled_from(TOKENS))
    tokens = list(pattern.finditer(data))
    if not tokens:
        return _overwrite(draw, data)
    token = draw(st.sampled_from(tokens))
    new = draw(others | others | st.sampled_from(tokens).map(lambda other: other[0]))
    return data[: token.start()] + new + data[token.end() :]


def _change_span(draw: st.DrawFn, data: bytes) -> bytes:
    """Delete or repeat some bytes."""
    start = draw(st.integers(0, len(data)))
    end = start + draw(st.sampled_from((1, 3, 10, 40, 200, 1000)))
    times = draw(st.sampled_from((0, 0, 2, 3, 50, 1000)))
    return data[:start] + data[start:end] * times + data[end:]


def _truncate(draw: st.DrawFn, data: bytes) -> bytes:
    return data[: draw(st.integers(0, len(data)))]


def _overwrite(draw: st.DrawFn, data: bytes) -> bytes:
    changed = bytearray(data)
    for _ in range(draw(st.sampled_from((1, 1, 2, 8, 64)))):
        if changed:
            changed[draw(st.integers(0, len(changed) - 1))] = draw(st.integers(0, 255))
    return bytes(changed)


def _recode(draw: st.DrawFn, data: bytes) -> bytes:
    return draw(st.sampled_from(RECODED))(data)


def _iterate_paths(data: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the paths of all values in dictionaries and lists."""
    if path:
        yield path
    if isinstance(data, dict | list):
        for key, value in data.items() if isinstance(data, dict) else enumerate(data):
            yield from _iterate_paths(value, (*path, key))


def get_value(data: Any, path: tuple[Any, ...]) -> Any:
    """Return the value at a path of keys and indices."""
    return functools.reduce(operator.getitem, path, data)


@st.composite
def change_data(
    draw: st.DrawFn, data: Any, values: st.SearchStrategy[Any] = JSON, most: int = 3
) -> Any:
    """Return a copy of dictionaries and lists with one to `most` changes."""
    data = copy.deepcopy(data)
    for _ in range(draw(st.integers(1, most))):
        paths = list(_iterate_paths(data))
        if not paths:
            break
        path = draw(st.sampled_from(paths))
        parent = get_value(data, path[:-1])
        key = path[-1]
        match draw(st.sampled_from(("set", "set", "set", "copy", "remove", "rename"))):
            case "set":
                parent[key] = draw(values)
            case "copy":
                parent[key] = copy.deepcopy(get_value(data, draw(st.sampled_from(paths))))
            case "remove":
                del parent[key]
            case _ if isinstance(parent, dict):
                parent[draw(TEXTS)] = parent.pop(key)
            case _:
                parent.insert(key, copy.deepcopy(parent[key]))
    return data
