"""What is of the wrong kind is refused by its kind, in a short message that names the argument."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.utils import arguments as check
from vkc_pin.world.files.resources import check_path


class Hostile:
    """Answers nothing that it is asked."""

    def _fail(self, *_: object) -> Any:
        raise RuntimeError("asked")

    __len__ = __iter__ = __getitem__ = __float__ = __int__ = __index__ = __bool__ = __eq__ = (
        __lt__
    ) = __repr__ = __str__ = _fail
    __hash__ = object.__hash__


CHECKS: dict[str, Callable[[Any], Any]] = {
    "number": lambda value: check.check_number(value, "it"),
    "quantity": lambda value: check.check_coordinate(value, "it"),
    "whole": lambda value: check.check_integer(value, "it", low=0),
    "numbers": lambda value: check.check_array(value, "it"),
    "text": lambda value: check.check_text(value, "it"),
    "flag": lambda value: check.check_bool(value, "it"),
    "known": lambda value: check.check_choice(value, ["door"], "object", "it"),
    "instance": lambda value: check.check_instance(value, Path, "it"),
    "mapping": lambda value: check.check_mapping(value, "it"),
    "items": lambda value: check.check_list(value, "it", "a list of texts", str),
    "file_path": lambda value: check_path(value, "it"),
}
WRONG = [
    None,
    Hostile(),
    [Hostile()],
    object(),
    {1, 2},
    1j,
    "x" * 100_000,
    "\x00",
    "a\ud800",
    {1: 2},
    [None],
    print,
    np.array([None]),
]
FITS = {("text", "\x00"), ("text", "x" * 100_000), ("items", None)}


@pytest.mark.parametrize("name", CHECKS)
@pytest.mark.parametrize("value", WRONG, ids=range(len(WRONG)))
def test_what_is_of_the_wrong_kind_is_refused(name: str, value: Any) -> None:
    if isinstance(value, str) and (name, value) in FITS:
        return
    with pytest.raises(InputError) as caught:
        CHECKS[name](value)
    assert str(caught.value.field).startswith("it")
    assert len(str(caught.value)) < 800


def test_numbers_have_bounds() -> None:
    assert (
        check.check_number(np.float32(0.5), "it"),
        check.check_number(np.array(2), "it"),
        check.check_coordinate(-1e4, "it"),
    ) == (0.5, 2.0, -1e4)
    for value in (np.nan, np.inf, -np.inf, 10**5000, True, np.bool_(True), "1"):
        with pytest.raises(InputError):
            check.check_number(value, "it")
    for wrong in (0.0, -1.0):
        with pytest.raises(InputError, match="it: out of range"):
            check.check_number(wrong, "it", low=0.0, strict=True)
    with pytest.raises(InputError, match="from -10000 to 10000, got 10001"):
        check.check_coordinate(10001, "it")
    with pytest.raises(InputError, match="an integer of 16610 bits"):
        check.check_integer(10**5000, "it", low=0)
    assert (
        check.check_integer(np.int8(3), "it", low=3),
        type(check.check_integer(np.int8(3), "it", low=3)),
    ) == (
        3,
        int,
    )


def test_arrays_are_of_real_numbers_and_copied() -> None:
    given = np.arange(3.0)
    found = check.check_array(given, "it")
    given[0] = 7.0
    assert found.tolist() == [0.0, 1.0, 2.0]
    assert check.check_array([], "it").shape == (0,)
    for value in (
        ["1", "2"],
        [1j],
        [True, False],
        [[1], [1, 2]],
        np.array(["2020"], "datetime64[Y]"),
        [10**5000],
        b"12",
    ):
        with pytest.raises(InputError, match="it: not numbers"):
            check.check_array(value, "it")


def test_lists_end() -> None:
    assert check.check_list((name for name in "ab"), "it", "texts", str) == ("a", "b")
    assert check.check_list({"a": 1}.keys(), "it", "texts", str) == ("a",)
    with pytest.raises(InputError, match="it: too many entries"):
        check.check_list(itertools.count(), "it", "numbers")
    for value in ("ab", b"ab", 3, {"a": 1}, {"a"}, np.array(3)):
        with pytest.raises(InputError, match="it: not a list"):
            check.check_list(value, "it", "texts")
    with pytest.raises(InputError, match=r"it\[1\]: wrong type of entry \(expected texts, got 3\)"):
        check.check_list(["a", 3], "it", "texts", str)


def test_names_are_those_that_there_are() -> None:
    assert check.check_choice(np.str_("door"), ["door"], "object") == "door"
    with pytest.raises(UnknownNameError, match="did you mean 'door'"):
        check.check_choice("dor", ["door"], "object")


def test_paths_can_be_those_of_files(tmp_path: Path) -> None:
    assert check_path(str(tmp_path), "it") == check_path(tmp_path, "it") == tmp_path
    for value in ("", "a\0b", "a\ud800", "x" * 256, "x/" * 2048, b"x", 3):
        with pytest.raises(InputError, match=r"^it: (no file can be called that|not a path)"):
            check_path(value, "it")
