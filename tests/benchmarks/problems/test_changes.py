"""Tests changes of planner settings for an experiment."""

from __future__ import annotations

import contextlib

import pytest

import vkc_pin as vkc
from tests.benchmarks.problems.changes import UNCHANGED, Change, parse_change
from vkc_pin.planning.solver import loop, trust_region


def test_changed_option_leaves_the_defaults_unchanged() -> None:
    change = parse_change("Options.dt=0.3")
    assert change == Change("Options", "dt", 0.3)
    assert str(change) == "Options.dt=0.3"
    assert change.options == vkc.Options(dt=0.3)
    with change.apply():
        assert vkc.Options() == UNCHANGED.options


def test_constant_is_changed_in_importing_modules_and_restored() -> None:
    before = trust_region.ACTIVE_FRACTION
    change = parse_change("solver.trust_region:ACTIVE_FRACTION=0.123")
    assert change.options == vkc.Options()
    with contextlib.suppress(KeyError), change.apply():
        assert trust_region.ACTIVE_FRACTION == loop.ACTIVE_FRACTION == 0.123
        raise KeyError
    assert trust_region.ACTIVE_FRACTION == loop.ACTIVE_FRACTION == before


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("Options.dt", "Options.field=value"),
        ("Options.dt=fast", "Options.field=value"),
        ("Options.dt=-1", "positive"),
        ("Options.dtt=1.0", "dt"),
        ("loop=1", "module:NAME=value"),
        ("scene.scene:START_CLEARANCE=1", "no such module"),
        ("solver.lop:PROGRESS=1", "no such module"),
        ("solver.loop:PROGRES=1", "PROGRESS"),
        ("solver.loop:PROGRESS='1'", "0.7"),
    ],
)
def test_wrong_changes_are_refused(text: str, expected: str) -> None:
    with pytest.raises(vkc.InputError, match=expected):
        parse_change(text)
