from __future__ import annotations

from typing import Any

import pytest

import vkc_pin as vkc


@pytest.mark.parametrize(
    ("changes", "field", "expected"),
    [
        ({"clutter": 1.1}, "clutter", "a number from 0 to 1"),
        ({"clutter": "much"}, "clutter", "a number from 0 to 1"),
        ({"width": 5.0}, "width", "two lengths"),
        ({"width": (3.0, 5.0)}, "width", "a number from 4 to 20"),
        ({"width": (6.0, 5.0)}, "width", "the lower one first"),
        ({"tables": 1.5}, "tables", "a whole number from 0 to 10"),
        ({"height": 1.0}, "height", "a number from 2.1"),
        ({"front": 0.2}, "front", "a number from 1.5"),
        ({"gap": 0.0}, "gap", "a number from 0.02"),
        ({"objects": "door"}, "objects", "a list of types"),
        ({"objects": (3,)}, "objects", "the name of a"),
        ({"carried": ("cup",) * 5}, "carried", "at most 4"),
        ({"carried": ("cup",), "tables": 0}, "carried", "at least 1"),
    ],
)
def test_invalid_settings_are_rejected(changes: dict[str, Any], field: str, expected: str) -> None:
    with pytest.raises(vkc.InputError) as caught:
        vkc.procedural.RoomSettings(**changes)
    assert caught.value.field == field
    assert expected in str(caught.value.expected)
    assert caught.value.got is not None


@pytest.mark.parametrize(
    ("field", "name", "nearest"),
    [
        ("objects", "dor", "door"),
        ("objects", "random_ovn", "random_oven"),
        ("carried", "cub", "cup"),
    ],
)
def test_unknown_types_are_rejected(field: str, name: str, nearest: str) -> None:
    with pytest.raises(vkc.UnknownNameError) as caught:
        vkc.procedural.RoomSettings(**{field: (name,)})  # type: ignore[arg-type]
    assert (caught.value.field, caught.value.name, caught.value.nearest) == (field, name, nearest)
