"""Tests the records of trials."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from helpers.fake_plan import make_fake_plan

from vkc_pin import PhaseSpan, Report, Trajectory
from vkc_pin.experiments.harness import record


def test_commit_is_none_without_git(monkeypatch: pytest.MonkeyPatch) -> None:
    record.find_commit.cache_clear()
    commit = record.find_commit()
    assert commit is None or len(commit) >= 7
    monkeypatch.setenv("PATH", "")
    record.find_commit.cache_clear()
    assert record.find_commit() is None
    record.find_commit.cache_clear()


def test_failure_is_recorded_with_the_first_violation() -> None:
    plan = make_fake_plan()
    trial = record.trial(plan, method="VKC", seed=3, number=7)
    expected = {"scene": "door", "method": "VKC", "seed": 3, "number": 7, "success": False}
    expected |= {"status": "rejected", "violations": [str(plan.report.violations[0])]}
    expected |= {"failed_constraint": "penetration forearm_link – sofa"}
    expected |= {"base_path_length": plan.metrics["base_path_length"]}
    expected |= {"waypoints": len(plan.trajectory.times)}
    assert {name: trial[name] for name in expected} == expected
    np.testing.assert_allclose(trial["start"], plan.scene.start, atol=1e-9)
    timed_out = dataclasses.replace(plan, status="time limit", report=Report())
    assert record.trial(timed_out, method="VKC", seed=0)["failed_constraint"] == "time limit"


def test_peaks_are_those_of_the_arm() -> None:
    names = ("x", "y", "yaw", "shoulder", "elbow", "door.hinge")
    positions = [  # base and object are faster than the arm
        [0.0, 0.0, 0.0, 0.0, 1.0, 0.0],
        [3.0, 4.0, 9.0, 0.5, 1.0, 9.0],
        [3.0, 4.0, 0.0, 0.1, -2.0, 0.0],
        [4.0, 3.0, 0.0, 0.1, -2.6, 0.0],
    ]
    times = np.array([0.0, 1.0, 3.0, 3.5])
    motion = Trajectory(names, times, np.array(positions), (PhaseSpan("move", 0, 3),), 5)
    # The elbow turns by -3 rad in 2 s; its velocity changes by 1.2 rad/s within 0.5 s.
    peaks = record.compute_peaks(motion)
    assert peaks == pytest.approx({"peak_velocity": 1.5, "peak_acceleration": 2.4})
