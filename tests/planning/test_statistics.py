"""Tests that planning statistics are added and that their records keep their keys."""

from __future__ import annotations

import dataclasses

from vkc_pin.planning.plan import STAGES, PlanningStatistics


def test_statistics_add_field_by_field() -> None:
    one = PlanningStatistics(1.0, 0.5, 3, 2, 100, coal_time=0.25)
    other = PlanningStatistics(0.5, 0.0, 1, 1, 11, coal_time=0.5, ipopt_time=0.125)
    total = one + other
    assert dataclasses.astuple(total) == (1.5, 0.5, 4, 3, 111, 0.0, 0.75, 0.0, 0.125, 0.0, 0.0, 0.0)
    assert sum([one, other], start=PlanningStatistics()) == total


def test_records_keep_their_keys() -> None:
    times = {stage: float(k) for k, stage in enumerate(STAGES)}
    statistics = PlanningStatistics(2.0, 1.0, 7, 3, 500).with_times(times)
    metrics = statistics.to_metrics()
    assert metrics == {
        "planning_time": 2.0,
        "build_time": 1.0,
        "iterations": 7.0,
        "rounds": 3.0,
        "evaluations": 500.0,
        **{f"time_{stage}": value for stage, value in times.items()},
    }
    assert PlanningStatistics.from_metrics(metrics) == statistics
    assert PlanningStatistics.from_metrics({}) == PlanningStatistics()
