"""Tests error messages."""

from __future__ import annotations

import pytest

from vkc_pin import InputError, UnknownNameError, VkcError
from vkc_pin.errors import find_nearest_name, format_value


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({}, "too large"),
        ({"file": "a.yaml", "line": 3, "field": "size"}, "a.yaml:3: size: too large"),
        ({"file": "a.yaml", "expected": "1", "got": 2}, "a.yaml: too large (expected 1, got 2)"),
        ({"field": "size", "got": 0}, "size: too large (got 0)"),
    ],
)
def test_messages_state_place_and_values(fields: dict[str, object], text: str) -> None:
    error = InputError("too large", **fields)  # type: ignore[arg-type]
    assert str(error) == text
    assert isinstance(error, ValueError)
    assert isinstance(error, VkcError)
    assert {name: getattr(error, name) for name in fields} == fields


def test_messages_about_unknown_names_suggest_the_nearest() -> None:
    error = UnknownNameError(
        "link", "wrst", ["base", "wrist", "hand"], file="r.yaml", line=2, field="tool"
    )
    assert (
        str(error) == "r.yaml:2: tool: there is no link 'wrst'; did you mean 'wrist'? "
        "There are: base, wrist, hand"
    )
    assert (error.nearest, error.choices) == ("wrist", ("base", "wrist", "hand"))
    assert str(UnknownNameError("link", "xyz", [])) == "there is no link 'xyz'; there are: none"
    many = UnknownNameError("link", "xyz", [f"l{k}" for k in range(20)])
    assert str(many).endswith("l11, ...")
    assert find_nearest_name("abc", ["abd", "xyz"]) == "abd"
    assert find_nearest_name("abc", ["xyz"]) is None


def test_messages_are_short_for_any_value() -> None:
    long, deep = "x" * 100_000, []  # type: ignore[var-annotated]
    deep.append(deep)
    for value in (long, [long] * 1000, 10**5000, deep, dict.fromkeys(range(1000), long)):
        assert (
            len(str(InputError("wrong", field=long, file=long, expected=value, got=value))) < 3000
        )
        assert len(format_value(value)) < 3000
    assert len(str(UnknownNameError(long, long, [long, "door"], field="it"))) < 3000
    assert (format_value([1, 2.5, "door"]), format_value(10**30)) == (
        "[1, 2.5, 'door']",
        str(10**30),
    )


def test_messages_contain_no_control_characters() -> None:
    name = "a\x1b[2J\nb\udcff\u202e.urdf"
    plain = r"a\x1b[2J\nb\udcff\u202e.urdf"
    assert str(InputError("wrong", file=name, field=name)) == f"{plain}: {plain}: wrong"
    unknown = UnknownNameError("link", name, [name + "x"])
    assert str(unknown).count(plain) == 3
    assert str(unknown).isprintable()
    assert (unknown.name, unknown.nearest) == (name, name + "x")
