"""Changes text, bytes and plain data at random."""

from __future__ import annotations

import copy
import random
import re
from collections.abc import Iterator
from typing import Any

from . import odd

__all__ = ["apply_changes", "choose_changes", "corrupt", "iterate_paths"]

_NUMBER = re.compile(rb"-?\d+\.?\d*(?:e-?\d+)?")
_WORD = re.compile(rb"[A-Za-z_][\w.]*")
_TAG = re.compile(rb"</?[A-Za-z_][^<>]*>")
_ATTRIBUTE = re.compile(rb"\s[\w:]+=\"[^\"]*\"")
_NUMBERS = (
    b"nan",
    b"inf",
    b"-inf",
    b"1e300",
    b"-1",
    b"0",
    b"0,2",
    b"1e-300",
    b"1e5",
    b"0x10",
    b"1_0",
    b"9" * 400,
    b"",
    b"true",
)
_WORDS = (
    b"",
    b"null",
    b"~",
    b"yes",
    b"!!python/object:os.system",
    b"&a",
    b"*a",
    b"- ",
    b"?",
    b"{",
    b"[",
    b"<",
    b"&amp;",
    b"..",
    b"/",
)


def corrupt(rng: random.Random, data: bytes, max_changes: int = 3) -> bytes:
    """Return the content of a file with one to `max_changes` changes."""
    for _ in range(rng.choice((1, 1, 2, max_changes))):
        data = rng.choice(_CHANGES)(rng, data)[:2_000_000]
    return data


def _flip(rng: random.Random, data: bytes) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8, 64))):
        if changed:
            changed[rng.randrange(len(changed))] = rng.randrange(256)
    return bytes(changed)


def _cut(rng: random.Random, data: bytes) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _choose_span(rng: random.Random, data: bytes) -> tuple[int, int]:
    start = rng.randrange(len(data) + 1)
    return start, min(len(data), start + rng.choice((1, 3, 10, 40, 200, 1000)))


def _delete(rng: random.Random, data: bytes) -> bytes:
    start, end = _choose_span(rng, data)
    return data[:start] + data[end:]


def _double(rng: random.Random, data: bytes) -> bytes:
    start, end = _choose_span(rng, data)
    return data[:end] + data[start:end] * rng.choice((1, 1, 2, 50, 1000)) + data[end:]


def _change_line(rng: random.Random, data: bytes) -> bytes:
    lines = data.split(b"\n")
    k, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    match rng.randrange(5):
        case 0:
            del lines[k]
        case 1:
            lines.insert(k, lines[other])
        case 2:
            lines[k], lines[other] = lines[other], lines[k]
        case 3:
            lines[k] = b" " * rng.choice((1, 2, 7)) + lines[k]
        case _:
            lines[k] = lines[k].strip()
    return b"\n".join(lines)


def _replace(
    rng: random.Random, data: bytes, pattern: re.Pattern[bytes], by: tuple[bytes, ...] = ()
) -> bytes:
    matches = list(pattern.finditer(data))
    if not matches:
        return _flip(rng, data)
    match = rng.choice(matches)
    new = rng.choice(by) if by and rng.random() < 0.7 else rng.choice(matches)[0]
    return data[: match.start()] + new + data[match.end() :]


def _change_number(rng: random.Random, data: bytes) -> bytes:
    if rng.random() < 0.4:  # a plausible number
        return _replace(
            rng,
            data,
            _NUMBER,
            tuple(
                b"%g" % rng.choice((rng.uniform(-3, 3), rng.uniform(0, 0.1), 1e3)) for _ in "abc"
            ),
        )
    return _replace(rng, data, _NUMBER, _NUMBERS)


def _change_word(rng: random.Random, data: bytes) -> bytes:
    return _replace(rng, data, _WORD, _WORDS)


def _change_attribute(rng: random.Random, data: bytes) -> bytes:
    return _replace(rng, data, _ATTRIBUTE, (b"",))


def _change_tag(rng: random.Random, data: bytes) -> bytes:
    matches = list(_TAG.finditer(data))
    if not matches:
        return _change_word(rng, data)
    match, other = rng.choice(matches), rng.choice(matches)
    new = rng.choice(
        (
            b"",
            other[0],
            match[0] * 2,
            b"<x>" + match[0],
            match[0] + b"</x>",
            b"<link/>",
            b"<joint/>",
            b"<mesh/>",
        )
    )
    return data[: match.start()] + new + data[match.end() :]


def _recode(rng: random.Random, data: bytes) -> bytes:
    text = data.decode("latin-1")
    return rng.choice(
        (
            text.encode("utf-16"),
            text.encode("utf-32"),
            b"\xef\xbb\xbf" + data,
            data.replace(b"\n", b"\r"),
            data.replace(b" ", b"\t"),
            data.replace(b"\n", b"\x00"),
            b"\x00" * len(data),
            b"",
            data.upper(),
        )
    )


def _surround(rng: random.Random, data: bytes) -> bytes:
    return rng.choice(
        (
            b"- " * 5000 + data,
            b"[" * 20000,
            b"{a: " * 3000,
            b"<robot name='x'>" * 3000,
            data * 20,
            b'<?xml version="1.0"?><!DOCTYPE r [<!ENTITY a "aaaaaaaaaa">'
            b'<!ENTITY b "&a;&a;&a;&a;">]><robot name="&b;"/>',
            b"a: &a [x, x]\nb: &b [*a, *a]\nc: &c [*b, *b]\n" + data,
            b"---\n" + data + b"\n---\n" + data,
        )
    )


_CHANGES = (
    _flip,
    _cut,
    _delete,
    _double,
    _change_line,
    _change_line,
    *[_change_number] * 6,
    _change_word,
    _change_word,
    _change_attribute,
    _change_tag,
    _change_tag,
    _recode,
    _surround,
)


def iterate_paths(data: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the paths of all values in plain data."""
    yield path
    if isinstance(data, dict | list):
        for key, value in data.items() if isinstance(data, dict) else enumerate(data):
            yield from iterate_paths(value, (*path, key))


def choose_changes(
    rng: random.Random, data: Any, values: tuple[str, ...] = tuple(odd.JSON_VALUES)
) -> list[list[Any]]:
    """Return one to three changes: a path, an operation, and a value, key or source path."""
    paths = [path for path in iterate_paths(data) if path]
    changes: list[list[Any]] = []
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        path = rng.choice(paths)
        operation = rng.choice(("set", "set", "set", "remove", "rename", "copy", "double"))
        operand: Any = rng.choice(values)
        if operation == "copy":
            operand = list(rng.choice(paths))
        elif operation == "rename":
            operand = rng.choice(("x", "", "name", "type", "a.b", "\ud800", "position"))
        changes.append([list(path), operation, operand])
    return changes


def apply_changes(data: Any, changes: list[list[Any]]) -> Any:
    """Return a changed copy of plain data, skipping changes whose path no longer exists."""
    data = copy.deepcopy(data)
    for path, operation, value in changes:
        try:
            parent, key = _get_at(data, path[:-1]), path[-1]
            parent[key]
            if operation == "set":
                parent[key] = odd.make_value(value)
            elif operation == "remove":
                del parent[key]
            elif operation == "copy":
                parent[key] = copy.deepcopy(_get_at(data, value))
            elif operation == "rename" and isinstance(parent, dict):
                parent[value] = parent.pop(key)
            elif operation == "double" and isinstance(parent, list):
                parent.insert(key, copy.deepcopy(parent[key]))
        except (LookupError, TypeError, ValueError):  # ValueError: an array replaced the value
            continue
    return data


def _get_at(data: Any, path: list[Any]) -> Any:
    for key in path:
        data = data[key]
    return data
