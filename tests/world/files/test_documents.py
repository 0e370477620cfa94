"""Tests YAML and JSON documents, and errors with file, line and field."""

from __future__ import annotations

import itertools
import os
import tempfile
from pathlib import Path
from typing import Any

import pytest
import yaml
from helpers.expected_errors import expect_error
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin import InputError, UnknownNameError
from vkc_pin.world.files import documents
from vkc_pin.world.files.documents import (
    Document,
    parse_document,
    parse_json,
    read_bytes,
    read_text,
    read_yaml,
)
from vkc_pin.world.files.fields import Name, Number, Positive, Schema, Vector3

NAMES = st.text("abcdefghnosy", min_size=1, max_size=4)
LEAVES = st.integers(-9, 9) | st.floats(-1e3, 1e3) | st.booleans() | NAMES
DATA = st.recursive(
    LEAVES,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(NAMES, inner, max_size=3),
    max_leaves=12,
)


class Part(Schema):
    size: Positive
    at: Vector3 = (0.0, 0.0, 0.0)


class Assembly(Schema):
    name: Name
    mass: Number = 1.0
    parts: tuple[Part, ...] = ()


def write_text(folder: Path, text: str) -> Path:
    file = folder / "thing.yaml"
    file.write_text(text)
    return file


def list_paths(data: Any, path: tuple[str | int, ...] = ()) -> list[tuple[str | int, ...]]:
    """Return the paths of all fields of nested data."""
    inner: Any = ()
    if isinstance(data, dict | list):
        inner = data.items() if isinstance(data, dict) else enumerate(data)
    return [path, *(found for key, value in inner for found in list_paths(value, (*path, key)))]


@settings(max_examples=50, deadline=None)
@given(st.dictionaries(NAMES, DATA, min_size=1, max_size=4))
def test_fields_are_read_with_their_lines(data: dict[str, Any]) -> None:
    text = yaml.safe_dump(data, default_flow_style=False, sort_keys=False)
    with tempfile.TemporaryDirectory() as folder:
        document = read_yaml(write_text(Path(folder), text))
    assert document.data == data
    for path in list_paths(data):
        assert document.find_line((*path, "nothing", 3)) == document.find_line(path)
        if path and isinstance(path[-1], str):
            line = text.splitlines()[(document.find_line(path) or 0) - 1]
            assert f"{path[-1]}:" in line.replace("'", "")


def test_empty_files_contain_no_data(tmp_path: Path) -> None:
    assert read_yaml(write_text(tmp_path, "# nothing\n")).data is None


def test_exponential_aliases_raise(tmp_path: Path) -> None:
    """Nine lines describe a billion items."""
    names = "abcdefghi"
    lines = [f"a: &a [{', '.join('x' * 9)}]"]
    lines += [
        f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]"
        for before, name in itertools.pairwise(names)
    ]
    with pytest.raises(InputError, match="too many fields") as caught:
        read_yaml(write_text(tmp_path, "\n".join(lines)))
    assert caught.value.line in range(1, 10)


@pytest.mark.parametrize(
    ("text", "line", "problem"),
    [
        ("a: 1\nb: 2\na: 3\n", 3, "twice"),
        ("a: [1, 2\nb: 3\n", 2, "not valid YAML"),
        ("a: &x [*x]\n", 1, "contains itself"),
        ("a: 2020-13-45\n", None, "not valid YAML"),
        ("a: !!python/object:os.system {}\n", 1, "not valid YAML"),
    ],
)
def test_invalid_yaml_raises(tmp_path: Path, text: str, line: int | None, problem: str) -> None:
    file = write_text(tmp_path, text)
    with expect_error(problem, file=file, line=line):
        read_yaml(file)


@pytest.mark.parametrize("word", ["on", "off", "yes", "No", "y", "n", "truely", "ON"])
def test_words_that_older_yaml_reads_as_booleans_are_names(tmp_path: Path, word: str) -> None:
    file = tmp_path / "a.yaml"
    file.write_text(f"name: {word}\nis: true\nnot: FALSE\n{word}: [{word}]\n")
    data = read_yaml(file).data
    assert data == {"name": word, "is": True, "not": False, word: [word]}


@pytest.mark.parametrize(
    ("text", "line", "field", "message"),
    [
        ("name: true\n", 1, "name", "text"),
        ("name: a\nmas: 2\n", 2, "mas", "did you mean 'mass'"),
        ("mass: 2\n", None, "name", "missing"),
        ("name: a\nmass: heavy\n", 2, "mass", "a number"),
        ("name: a\nmass: yes\n", 2, "mass", "a number"),
        ("name: a\nmass: .inf\n", 2, "mass", "a finite number"),
        ("name: a/b\n", 1, "name", "not a name"),
        ('name: "a\\0"\n', 1, "name", "not a name"),
        ("name: a\nparts:\n  - size: 1\n    at: [1, 2]\n", 4, "parts[0].at", "3 values"),
        ("name: a\nparts: 3\n", 2, "parts", "a list"),
        ("parts: [{size: 0}]\nname: 3\n", 1, "parts[0].size", "a number from 1e-06 to 10000"),
    ],
)
def test_the_first_invalid_field_is_reported(
    tmp_path: Path, text: str, line: int | None, field: str, message: str
) -> None:
    with pytest.raises(InputError, match=message) as caught:
        parse_document(read_yaml(write_text(tmp_path, text)), Assembly)
    assert (caught.value.field, caught.value.file) == (field, tmp_path / "thing.yaml")
    assert line is None or caught.value.line == line


@pytest.mark.parametrize(("opening", "closing"), [("[", "]"), ("{a: ", "}")])
def test_deeply_nested_yaml_raises(tmp_path: Path, opening: str, closing: str) -> None:
    depth = documents.MAX_DEPTH
    nested = read_yaml(write_text(tmp_path, opening * depth + "1" + closing * depth))
    assert len(max(nested.lines, key=len)) == depth
    for count in (depth + 1, 1_000_000):
        with expect_error(r"too many lists|not valid YAML"):
            read_yaml(write_text(tmp_path, opening * count + "1" + closing * count))


def test_unencodable_endless_or_recursive_data_raise() -> None:
    for data in ({"name": "x", "parts": ["a\ud800"]}, {"x\udfff": [1]}, ["\ud800"]):
        with expect_error("not text"):
            parse_document(Document(data), Assembly)
    with expect_error("parts: wrong type of value"):
        parse_document(Document({"parts": itertools.count()}), Assembly)
    recursive: dict[str, object] = {}
    recursive["inside"] = recursive
    with expect_error("inside: too many lists inside each other"):
        parse_document(Document(recursive), Assembly)


def test_errors_are_annotated_with_the_line_of_their_field(tmp_path: Path) -> None:
    document = read_yaml(write_text(tmp_path, "a: 1\nb:\n  c: 2\n"))
    with (
        expect_error(r":3: b\.c: mass: too large"),
        document.annotate_errors(("b", "c")),
    ):
        raise InputError("too large", field="mass", expected=1, got=2)
    with expect_error(line=2, nearest="arm"), document.annotate_errors(("b",)):
        raise UnknownNameError("link", "armm", ["arm", "leg"])
    located = InputError("too large", file="other.yaml", line=7)
    with pytest.raises(InputError) as same, document.annotate_errors(("b",)):
        raise located
    assert same.value is located


def test_size_and_type_of_files_are_limited(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"\xef\xbb\xbfabc")
    assert (read_bytes(file, "plan"), read_text(file, "plan")) == (b"\xef\xbb\xbfabc", "abc")
    with expect_error(r"the plan is too large .expected at most 5 bytes, got 6"):
        read_bytes(file, "plan", 5)
    monkeypatch.setattr(documents, "MAX_FILE_SIZE", 3)
    with expect_error("the YAML is too large"):
        read_yaml(file)
    (tmp_path / "bytes").write_bytes(b"\xff\xfe\x00")
    os.mkfifo(tmp_path / "pipe")  # without a writer
    for name in ("none", "bytes", ".", "pipe", "a\0b"):
        with expect_error("cannot read the YAML", file=tmp_path / name):
            read_text(tmp_path / name, "YAML")


def test_size_and_depth_of_json_are_limited() -> None:
    assert parse_json('{"a": [1, {"b": "[["}]}', "file") == {"a": [1, {"b": "[["}]}
    deepest = "[" * documents.MAX_DEPTH + "]" * documents.MAX_DEPTH
    assert str(parse_json(deepest, "file")) == deepest
    for text, message in (
        (f"[{deepest}]", "too many lists and objects inside each other"),
        ("[" * 100_000, "not JSON"),
        ("[" + "[]," * documents.MAX_FIELDS + "[]]", "too many lists and objects .expected"),
        ("1" * 5000, "not JSON"),
        ("[1,\n2,,]", "file:2: not JSON"),
    ):
        with expect_error(message, file="file"):
            parse_json(text, "file")
