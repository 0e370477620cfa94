"""What trials may take, in words; also of records from before there was a budget."""

from __future__ import annotations

from vkc_pin.benchmarks.harness.limits import LIMITS, allowed


def test_in_words() -> None:
    assert allowed({**LIMITS, "seed": 3}) == "at most 1 000 000 evaluations"
    assert allowed({"time_limit": 20.0}) == "at most 20 s of planning"
