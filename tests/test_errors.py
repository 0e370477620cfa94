"""Errors say where, what, what was expected, what came, and which name was meant."""

from __future__ import annotations

import pytest

from vkc_pin.errors import InputError, UnknownNameError, VkcError, nearest_name


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({}, "too large"),
        ({"file": "a.yaml", "line": 3, "field": "size"}, "a.yaml:3: size: too large"),
        ({"file": "a.yaml", "expected": "1", "got": 2}, "a.yaml: too large (expected 1, got 2)"),
        ({"field": "size", "got": 0}, "size: too large (got 0)"),
    ],
)
def test_text_of_an_error(given: dict[str, object], text: str) -> None:
    error = InputError("too large", **given)  # type: ignore[arg-type]
    assert str(error) == text
    assert isinstance(error, ValueError)
    assert isinstance(error, VkcError)
    assert {name: getattr(error, name) for name in given} == given


def test_the_name_that_was_meant() -> None:
    error = UnknownNameError("link", "wrst", ["base", "wrist", "hand"], file="r.yaml", line=2, field="tool")
    assert str(error) == "r.yaml:2: tool: there is no link 'wrst'; did you mean 'wrist'? There are: base, wrist, hand"
    assert (error.nearest, error.choices) == ("wrist", ("base", "wrist", "hand"))
    assert str(UnknownNameError("link", "xyz", [])) == "there is no link 'xyz'; there are: none"
    many = UnknownNameError("link", "xyz", [f"l{k}" for k in range(20)])
    assert str(many).endswith("l11, ...")
    assert nearest_name("abc", ["abd", "xyz"]) == "abd"
    assert nearest_name("abc", ["xyz"]) is None
