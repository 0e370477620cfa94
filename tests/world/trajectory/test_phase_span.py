"""Tests the conversion of phase spans to data and back."""

from __future__ import annotations

from typing import Any

import pytest
from helpers.expected_errors import expect_error

from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.trajectory.phase_span import PhaseSpan

STICK = Hold("stick", "grip")


@pytest.mark.parametrize(
    "span",
    [
        PhaseSpan("go", 0, 4),
        PhaseSpan("carry", 2, 3, (STICK, Hold("ball", "pull", STICK, "tip"))),
        PhaseSpan("open", 1, 7, (Hold("door", "handle"),), 0.04),
    ],
)
def test_phase_spans_survive_a_round_trip_through_data(span: PhaseSpan) -> None:
    data = span.to_dict()
    assert ("opening" in data) == (span.opening is not None)
    assert PhaseSpan.from_dict(data, "phases[0]") == span


@pytest.mark.parametrize(
    ("wrong", "field"),
    [
        ({"first": -1}, "PhaseSpan.first"),
        ({"name": 3}, "PhaseSpan.name"),
        ({"opening": -0.1}, "PhaseSpan.opening"),
        ({"opening": "wide"}, "PhaseSpan.opening"),
    ],
)
def test_invalid_fields_are_rejected(wrong: dict[str, Any], field: str) -> None:
    with expect_error(field=field):
        PhaseSpan.from_dict({**PhaseSpan("go", 0, 4).to_dict(), **wrong}, "phases[0]")


def test_missing_fields_are_named() -> None:
    with expect_error("held: this is missing from a trajectory"):
        PhaseSpan.from_dict({"name": "go", "first": 0, "last": 1}, "phases[0]")
    with expect_error(r"phases\[3\]"):
        PhaseSpan.from_dict("go", "phases[3]")
