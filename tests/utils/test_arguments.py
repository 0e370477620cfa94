"""Tests that wrong types raise short errors that name the argument."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.expected_errors import expect_error

from vkc_pin import InputError
from vkc_pin.utils.arguments import (
    check_array,
    check_bool,
    check_choice,
    check_coordinate,
    check_finite_array,
    check_instance,
    check_integer,
    check_list,
    check_mapping,
    check_number,
    check_text,
)
from vkc_pin.world.files.resources import check_path


class Hostile:
    """Raises an error in every operation."""

    def _fail(self, *_: object) -> Any:
        raise RuntimeError("asked")

    __len__ = __iter__ = __float__ = __int__ = __index__ = __bool__ = __eq__ = __repr__ = _fail
    __hash__ = object.__hash__


CHECKS: dict[str, Callable[[Any], Any]] = {
    "number": lambda value: check_number(value, "it"),
    "coordinate": lambda value: check_coordinate(value, "it"),
    "integer": lambda value: check_integer(value, "it", low=0),
    "array": lambda value: check_array(value, "it"),
    "text": lambda value: check_text(value, "it"),
    "bool": lambda value: check_bool(value, "it"),
    "choice": lambda value: check_choice(value, ["door"], "object", "it"),
    "instance": lambda value: check_instance(value, Path, "it"),
    "mapping": lambda value: check_mapping(value, "it"),
    "list": lambda value: check_list(value, "it", "a list of texts", str),
    "path": lambda value: check_path(value, "it"),
}


WRONG = [None, Hostile(), [Hostile()], {1, 2}, "a\ud800", {1: 2}, [None], print, np.array([None])]


@pytest.mark.parametrize("name", CHECKS)
@pytest.mark.parametrize("value", WRONG, ids=range(len(WRONG)))
def test_wrong_types_raise(name: str, value: Any) -> None:
    with pytest.raises(InputError) as caught:
        CHECKS[name](value)
    assert str(caught.value.field).startswith("it")
    assert len(str(caught.value)) < 800


def test_arrays_hold_real_numbers_and_are_copies() -> None:
    source = np.arange(3.0)
    found = check_array(source, "it")
    source[0] = 7.0
    assert found.tolist() == [0.0, 1.0, 2.0]
    assert check_array([], "it").shape == (0,)
    assert check_finite_array([[1, 2]], "it").tolist() == [[1.0, 2.0]]
    with expect_error(r"it\[0, 1\]: not finite"):
        check_finite_array([[1, np.nan]], "it")
    for value in (["1", "2"], [1j], [True, False], [[1], [1, 2]], [10**5000], b"12"):
        with expect_error("it: not numbers"):
            check_array(value, "it")


def test_lists_are_finite_and_typed() -> None:
    assert check_list((name for name in "ab"), "it", "texts", str) == ("a", "b")
    assert check_list({"a": 1}.keys(), "it", "texts", str) == ("a",)
    with expect_error("it: too many entries"):
        check_list(itertools.count(), "it", "numbers")
    for value in ("ab", b"ab", {"a": 1}, {"a"}, np.array(3)):
        with expect_error("it: not a list"):
            check_list(value, "it", "texts")
    with expect_error(r"it\[1\]: wrong type of entry \(expected texts, got 3\)"):
        check_list(["a", 3], "it", "texts", str)


def test_paths_have_valid_names(tmp_path: Path) -> None:
    assert check_path(str(tmp_path), "it") == check_path(tmp_path, "it") == tmp_path
    for value in ("", "a\0b", "x" * 256, "x/" * 2048, b"x"):
        with expect_error(r"^it: (no file can be called that|not a path)"):
            check_path(value, "it")


def test_numbers_have_bounds() -> None:
    assert check_number(np.float32(0.5), "it") == 0.5
    assert check_number(np.array(2), "it") == 2.0
    assert check_coordinate(-1e4, "it") == -1e4
    for value in (np.nan, np.inf, -np.inf, 10**5000, True, np.bool_(True), "1"):
        with pytest.raises(InputError):
            check_number(value, "it")
    for wrong in (0.0, -1.0):
        with expect_error("it: out of range"):
            check_number(wrong, "it", low=0.0, strict=True)
    with expect_error("from -10000 to 10000, got 10001"):
        check_coordinate(10001, "it")
    with expect_error("an integer of 16610 bits"):
        check_integer(10**5000, "it", low=0)
    with expect_error("from 0 to 9223372036854775807, got"):
        check_integer(2**63, "it", low=0)
    whole = check_integer(np.int8(3), "it", low=3)
    assert (whole, type(whole)) == (3, int)
