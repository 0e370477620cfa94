"""Tests the descriptions of trial limits."""

from __future__ import annotations

from vkc_pin.benchmarks.harness.runner import LIMITS, describe_limit


def test_description_states_evaluations_or_planning_time() -> None:
    assert describe_limit({**LIMITS, "seed": 3}) == "at most 1 000 000 evaluations"
    assert describe_limit({"time_limit": 20.0}) == "at most 20 s of planning"
