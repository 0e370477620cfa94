"""Tests the checks of options."""

from __future__ import annotations

import json
from dataclasses import asdict, fields
from typing import Any

import numpy as np
import pytest

from vkc_pin import InputError, Options

INTEGERS = [item.name for item in fields(Options) if item.type == "int"]
REALS = [item.name for item in fields(Options) if item.type == "float"]


def test_every_option_is_documented() -> None:
    assert sorted([*INTEGERS, *REALS, "objective"]) == sorted(item.name for item in fields(Options))
    assert "dist_safe" in REALS
    assert "move_waypoints" in INTEGERS
    assert Options.__doc__ is not None
    for item in fields(Options):
        assert f"        {item.name}: " in Options.__doc__


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((name, value) for name in INTEGERS for value in (-1, 2.0, True, "4", None)),
        *((name, 0) for name in INTEGERS if name != "max_refinements"),
        *((name, value) for name in REALS for value in (-1.0, np.nan, np.inf, "0.1")),
        *((name, 0.0) for name in REALS if name != "jerk_time"),
        *(("objective", value) for value in ("lengths", None, 1, np.nan)),
        ("reach_waypoints", 5000),
        ("move_waypoints", 501),
        ("contact_slots", 1000),
        ("max_restarts", 10**9),
        ("max_refinements", 5),
        ("dt", 1e-9),
        ("dt", 1e9),
        *(("jerk_time", value) for value in (5e-324, 1e-12, 1e-9, 1e-4, 4.9e-3, 11.0)),
    ],
)
def test_invalid_values_raise(name: str, value: Any) -> None:
    with pytest.raises(InputError) as caught:
        Options(**{name: value})
    assert caught.value.field == f"Options.{name}"


def test_numbers_become_builtin_types() -> None:
    """JSON has no NumPy types."""
    values = {name: np.int64(4) for name in INTEGERS} | {name: np.float32(0.5) for name in REALS}
    options = Options(**values)
    assert Options(**json.loads(json.dumps(asdict(options)))) == options
    assert {type(getattr(options, name)) for name in INTEGERS} == {int}
    assert {type(getattr(options, name)) for name in REALS} == {float}
    assert Options(dt=1).dt == 1.0


def test_times_are_rounded_to_steps() -> None:
    assert [Options().steps(seconds) for seconds in (0.01, 1.0, 2.5)] == [1, 4, 10]
    assert Options(dt=0.1).steps(1.0) == 10


def test_options_of_the_paper_have_equal_weights() -> None:
    paper = Options.paper(dt=0.5, velocity_weight_base=2.0)
    assert (paper.objective, paper.dt, paper.velocity_weight_base) == ("control_effort", 0.5, 2.0)
    assert {getattr(paper, f"velocity_weight_{n}") for n in ("heading", "arm", "object")} == {1.0}


@pytest.mark.parametrize("value", [0, 0.0, -0.0, 0.005, 10])
def test_jerk_time_may_be_zero_or_in_range(value: float) -> None:
    assert Options(jerk_time=value).jerk_time == value
