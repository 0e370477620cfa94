"""Tests fixtures created by name, path or description, and their sizes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import vkc_pin as vkc
from vkc_pin.procedural.rooms.fixtures import make_fixture, make_fixture_name


def test_bounding_box_is_that_of_the_closed_object() -> None:
    drawer = make_fixture("drawer")
    expected = [[-0.125, -0.3, 0.0], [0.55, 0.3, 0.9]]
    np.testing.assert_allclose([drawer.low, drawer.high], expected, atol=6e-3)
    assert (drawer.type, drawer.lift, drawer.counter) == ("drawer", 0.0, None)
    assert not drawer.in_wall
    door = make_fixture("narrow_door")
    assert (door.low[1], door.high[1]) == pytest.approx((-0.81, 0.095))
    assert door.in_wall


def test_fixtures_are_named_after_their_type_or_file() -> None:
    assert make_fixture_name("random_oven") == "oven"
    assert make_fixture_name("/some/where/my.oven.yaml") == "my_oven"
    assert make_fixture_name(vkc.procedural.random_object("valve")) == "valve"


def test_sizes_depend_on_the_seed() -> None:
    one, same, other = (make_fixture("random_microwave", seed) for seed in (1, 1, 2))
    assert (one.type, one.counter) == (same.type, same.counter)
    assert one.type != other.type
    assert one.counter != other.counter


def test_raised_object_is_lowered_to_the_floor(tmp_path: Path) -> None:
    description = vkc.procedural.random_object("oven", 1)
    body = '<link name="body">'
    joint = '<joint name="up" type="fixed"><parent link="root"/><child link="body"/>'
    raised = f'<link name="root"/>{joint}<origin xyz="0 0 0.7"/></joint>{body}'
    description["urdf"] = description["urdf"].replace(body, raised)
    assert make_fixture(description).lift == pytest.approx(-0.7, abs=1e-3)


@pytest.mark.parametrize(
    ("kind", "nearest"), [("cabinett", "cabinet"), ("random_ovn", "random_oven")]
)
def test_unknown_objects_are_rejected(kind: str, nearest: str) -> None:
    with pytest.raises(vkc.UnknownNameError) as caught:
        make_fixture(kind)
    assert (caught.value.field, caught.value.nearest) == ("objects", nearest)


def test_free_objects_are_rejected() -> None:
    with pytest.raises(vkc.InputError, match="a free object cannot be a fixture"):
        make_fixture("cup")
