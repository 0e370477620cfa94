"""Reads YAML, JSON and text files, checks them, and reports errors with file, line and field."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Set
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import pydantic
import yaml

from vkc_pin.errors import InputError, UnknownNameError, format_value

MAX_FILE_SIZE = 50_000_000
"""Largest description file [bytes]."""
MAX_FIELDS = 300_000
"""Most fields and items that a YAML file may have, with those of its aliases."""
MAX_DEPTH = 50
"""Most lists and fields inside each other."""

Key = str | int
T = TypeVar("T")

_EXPECTED = {
    "bool_parsing": "true or false",
    "bool_type": "true or false",
    "dataclass_type": "fields (name: value)",
    "int_type": "a whole number",
    "dict_type": "fields (name: value)",
    "finite_number": "a finite number",
    "float_parsing": "a number",
    "float_type": "a number",
    "list_type": "a list",
    "model_attributes_type": "fields (name: value)",
    "model_type": "fields (name: value)",
    "string_type": "text",
    "tuple_type": "a list",
}
_NUMBERS = (float, int)
_FINITE = (Mapping, Set, bytes, bytearray, np.ndarray)  # iterables that end
_SIGNS = {
    "greater_than": ">",
    "greater_than_equal": ">=",
    "less_than": "<",
    "less_than_equal": "<=",
}


def format_field(path: tuple[Key, ...]) -> str | None:
    """Return the path of a field as users write it, `obstacles[3].size`; None for the whole."""
    text = ""
    for key in path:
        text += f"[{key}]" if isinstance(key, int) else f".{key}"
    return text.removeprefix(".") or None


@dataclass(frozen=True)
class Document:
    """Plain data with the line of each field.

    Attributes:
        data: Dictionaries, lists, text and numbers.
        file: File of the data, or None for arguments.
        lines: Path of a field → line, counted from 1; empty for arguments.
    """

    data: Any
    file: Path | None = None
    lines: dict[tuple[Key, ...], int] = field(default_factory=dict)

    def find_line(self, path: tuple[Key, ...]) -> int | None:
        """Return the line of the field at `path`, or of its closest parent."""
        while path and path not in self.lines:
            path = path[:-1]
        return self.lines.get(path)

    def make_error(
        self, path: tuple[Key, ...], problem: str, *, expected: object = None, got: object = None
    ) -> InputError:
        """Return the error for the field at `path`."""
        return InputError(
            problem,
            file=self.file,
            line=self.find_line(path),
            field=format_field(path),
            expected=expected,
            got=got,
        )

    def make_unknown_name_error(
        self, path: tuple[Key, ...], kind: str, name: object, choices: Iterator[str] | Any
    ) -> UnknownNameError:
        """Return the error for an unknown name in the field at `path`."""
        return UnknownNameError(
            kind,
            str(name),
            choices,
            file=self.file,
            line=self.find_line(path),
            field=format_field(path),
        )

    @contextmanager
    def annotate_errors(self, path: tuple[Key, ...]) -> Iterator[None]:
        """Add file, line and field to errors raised inside, unless they name a file."""
        try:
            yield
        except InputError as error:
            if error.file is not None:
                raise
            if isinstance(error, UnknownNameError):
                raise self.make_unknown_name_error(
                    path, error.kind, error.name, error.choices
                ) from error
            problem = f"{error.field}: {error.problem}" if error.field else error.problem
            raise self.make_error(path, problem, expected=error.expected, got=error.got) from error


def read_head(file: str | Path, kind: str, count: int) -> bytes:
    """Return the first bytes of a file, at most `count`; see `read_bytes`."""
    return _read_start(file, kind, count)[0]


def read_bytes(file: str | Path, kind: str, largest: int | None = None) -> bytes:
    """Return a file of a `kind` ("YAML", "plan"), up to `largest` or `MAX_FILE_SIZE` bytes."""
    if largest is None:
        largest = MAX_FILE_SIZE
    data, size = _read_start(file, kind, largest + 1)
    if size > largest:
        raise InputError(
            f"the {kind} is too large", file=file, expected=f"at most {largest:g} bytes", got=size
        )
    return data


def _read_start(file: str | Path, kind: str, count: int) -> tuple[bytes, int]:
    """Return the first bytes of a file, at most `count`, and its size [bytes]."""
    path = Path(file)
    expected = f"an existing {kind} file"
    try:
        is_special = path.exists() and not path.is_file() and not path.is_dir()
        # Reading a pipe would wait for ever.
        if is_special:
            raise InputError(
                f"cannot read the {kind}", file=file, expected=expected, got="a pipe or a device"
            )
        with path.open("rb") as stream:
            data = stream.read(count)
            return data, max(len(data), os.fstat(stream.fileno()).st_size)
    except InputError:
        raise
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        got = getattr(error, "strerror", None) or error
        raise InputError(
            f"cannot read the {kind}", file=file, expected=expected, got=got
        ) from error


def read_text(file: str | Path, kind: str, largest: int | None = None) -> str:
    """Return the contents of a text file; see `read_bytes`."""
    try:
        return read_bytes(file, kind, largest).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        got = f"no text: byte {error.start} is {error.object[error.start]:#04x}"
        raise InputError(
            f"cannot read the {kind}", file=file, expected=f"a {kind} file in UTF-8", got=got
        ) from None


def parse_json(text: str, file: str | Path) -> Any:
    """Return the data of a JSON text."""
    # Counted before they are made: each takes twenty times the memory of its text.
    many = text.count("[") + text.count("{")
    if many > MAX_FIELDS:
        raise InputError(
            "too many lists and objects", file=file, expected=f"at most {MAX_FIELDS}", got=many
        )
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError("not JSON", file=file, line=error.lineno, got=error.msg) from None
    except (RecursionError, ValueError) as error:  # ValueError: thousands of digits in a number
        raise InputError("not JSON", file=file, got=error) from None
    if _exceeds_depth(data):
        raise InputError(
            "too many lists and objects inside each other",
            file=file,
            expected=f"at most {MAX_DEPTH}",
        )
    return data


def _exceeds_depth(data: Any) -> bool:
    """Return whether there are more than `MAX_DEPTH` lists and objects inside each other."""
    level = [data]
    for _ in range(MAX_DEPTH):
        inner: list[Any] = []
        for item in level:
            if isinstance(item, dict):
                inner += item.values()
            elif isinstance(item, list):
                inner += item
        level = [item for item in inner if isinstance(item, dict | list)]
    return bool(level)


# The loader in C is ten times as fast, and not everywhere.
_FastLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_FastLoader):
    """Reads true and false alone as booleans, as YAML 1.2 does: an object may be called `on`."""

    yaml_implicit_resolvers: ClassVar[dict[str, Any]] = {
        first: [(tag, pattern) for tag, pattern in resolvers if tag != "tag:yaml.org,2002:bool"]
        for first, resolvers in _FastLoader.yaml_implicit_resolvers.items()
    }


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:bool", re.compile("(true|True|TRUE|false|False|FALSE)$"), list("tTfF")
)


def read_yaml(file: str | Path) -> Document:
    """Read a YAML file, with the line of every field."""
    path = Path(file)
    text = read_text(path, "YAML")
    loader = _Loader(text)
    lines = dict[tuple[Key, ...], int]()
    try:
        _check_depth(yaml.parse(text, Loader=_Loader), path)
        node = loader.get_single_node()
        if node is not None:
            _record_lines(node, (), lines, path, set())
        data = None if node is None else loader.construct_document(node)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else None
        problem = "; ".join(part for part in (error.context, error.problem) if part)
        raise InputError(f"not valid YAML: {problem}", file=path, line=line) from error
    except InputError:
        raise
    except (yaml.YAMLError, RecursionError, ValueError, TypeError) as error:
        raise InputError(f"not valid YAML: {error}", file=path) from error
    finally:
        loader.dispose()
    return Document(data, path, lines)


def parse_document(document: Document, schema: type[T]) -> T:
    """Return `document` as an instance of `schema`, a pydantic model or a `StoredRecord`."""
    _check_plain(document)
    adapter: pydantic.TypeAdapter[T] = _make_adapter(schema)  # type: ignore[arg-type] # hashable
    try:
        return adapter.validate_python(document.data)
    except pydantic.ValidationError as problem:
        errors = problem.errors(include_url=False)
    located = [(_find_error_path(document.data, error), error) for error in errors]
    path, first = min(located, key=lambda item: document.find_line(item[0]) or 0)
    raise _translate_error(document, path, first)


@cache
def _make_adapter(schema: Any) -> pydantic.TypeAdapter[Any]:
    return pydantic.TypeAdapter(schema)


def _check_plain(document: Document) -> None:
    """Reject endless iterators, recursive data, and text that UTF-8 cannot encode."""
    left: list[tuple[tuple[Key, ...], Any]] = [((), document.data)]
    while left:
        path, value = left.pop()
        if len(path) > MAX_DEPTH:  # data that contain themselves have no end
            raise document.make_error(
                path[:1], "too many lists inside each other", expected=f"at most {MAX_DEPTH}"
            )
        if isinstance(value, dict):
            left += [(path, name) for name in value if isinstance(name, str)]
            for name, entry in value.items():
                key = name if isinstance(name, int | str) else format_value(name)
                left.append(((*path, key), entry))
        elif isinstance(value, list | tuple):
            for place, entry in enumerate(value):
                # Motions have lists of 100 000 numbers.
                if not isinstance(entry, _NUMBERS):
                    left.append(((*path, place), entry))
        elif isinstance(value, str):
            _check_encodable(document, path, value)
        elif isinstance(value, Iterable) and not isinstance(value, _FINITE):
            raise document.make_error(
                path,
                "wrong type of value",
                expected="a list, fields, text or a number",
                got=format_value(value),
            )


def _check_encodable(document: Document, path: tuple[Key, ...], text: str) -> None:
    try:
        text.encode("utf-8")
    except UnicodeEncodeError:
        raise document.make_error(
            path, "not text", expected="text in UTF-8", got=ascii(text)
        ) from None


def _check_depth(events: Iterable[yaml.Event], file: Path) -> None:
    """Reject deeply nested YAML before it is built, which is recursive."""
    depth = 0
    for event in events:
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > MAX_DEPTH:
                line = event.start_mark.line + 1 if event.start_mark else None
                raise InputError(
                    "too many lists inside each other",
                    file=file,
                    line=line,
                    expected=f"at most {MAX_DEPTH}",
                )
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1


def _record_lines(
    node: yaml.Node,
    path: tuple[Key, ...],
    lines: dict[tuple[Key, ...], int],
    file: Path,
    above: set[int],
) -> None:
    """Add the lines of `node` and its descendants; `above` has the ids of its parents."""
    line = node.start_mark.line + 1
    lines.setdefault(path, line)
    if len(lines) > MAX_FIELDS:  # a few lines of aliases of aliases make any number
        raise InputError("too many fields", file=file, line=line, expected=f"at most {MAX_FIELDS}")
    if id(node) in above:
        raise InputError("an alias contains itself", file=file, line=line, field=format_field(path))
    above = above | {id(node)}
    if isinstance(node, yaml.MappingNode):
        seen: dict[str, int] = {}
        for key, value in node.value:
            name = key.value if isinstance(key, yaml.ScalarNode) else str(key.value)
            inner = (*path, name)
            line = key.start_mark.line + 1
            if name in seen:
                raise InputError(
                    "this field stands here twice",
                    file=file,
                    line=line,
                    field=format_field(inner),
                    got=f"lines {seen[name]} and {line}",
                )
            seen[name] = line
            lines[inner] = line
            _record_lines(value, inner, lines, file, above)
    elif isinstance(node, yaml.SequenceNode):
        for index, item in enumerate(node.value):
            _record_lines(item, (*path, index), lines, file, above)


def _find_error_path(data: Any, error: Any) -> tuple[Key, ...]:
    """Return the path of pydantic's error in the data, without the tags of unions."""
    kind = error["type"]
    location = error["loc"]
    path: list[Key] = []
    for position, key in enumerate(location):
        is_entry = isinstance(data, list | tuple) and isinstance(key, int) and key < len(data)
        if is_entry or (isinstance(data, dict) and key in data):
            path.append(key)
            data = data[key]
        elif kind == "missing" and position == len(location) - 1:
            path.append(key)
    if kind in ("unknown_field", "missing_field"):
        path.append(error["ctx"]["name"])
    elif kind in ("union_tag_invalid", "union_tag_not_found"):
        path.append(error["ctx"]["discriminator"].strip("'"))
    return tuple(path)


def _translate_error(document: Document, path: tuple[Key, ...], error: Any) -> InputError:
    """Return pydantic's error as one that names line and field."""
    kind = error["type"]
    context = error.get("ctx", {})
    value = error["input"]
    if kind == "unknown_field":
        return document.make_unknown_name_error(path, "field", context["name"], context["choices"])
    if kind in ("union_tag_invalid", "literal_error"):
        listed = context["expected_tags" if kind == "union_tag_invalid" else "expected"]
        choices = re.findall(r"'([^']*)'", listed)
        name = context.get("tag", value)
        return document.make_unknown_name_error(path, str(path[-1]), name, choices)
    problem, expected, got = _describe_error(kind, context, value, error["msg"])
    return document.make_error(path, problem, expected=expected, got=got)


def _describe_error(
    kind: str, context: Mapping[str, Any], value: Any, message: str
) -> tuple[str, object, object]:
    """Return the problem of a value, what was expected, and what came."""
    got = format_value(value)
    if kind in ("missing", "missing_field"):
        return "missing", "a value", "nothing"
    if kind == "union_tag_not_found":
        return "missing", "the object's kind", "nothing"
    if kind == "too_long":
        return "too many", f"at most {context['max_length']}", context["actual_length"]
    if kind == "vkc":
        return context["problem"], context["expected"], got
    if kind in _SIGNS:
        (limit,) = context.values()
        return "out of range", f"a number {_SIGNS[kind]} {limit:g}", got
    return "wrong value", _EXPECTED.get(kind, message), got
