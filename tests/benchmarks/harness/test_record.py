"""Records say of which commit the sources are."""

from __future__ import annotations

import dataclasses

import pytest

import vkc_pin as vkc
from vkc_pin.benchmarks.harness import record


def test_the_commit(monkeypatch: pytest.MonkeyPatch) -> None:
    record.commit.cache_clear()
    found = record.commit()
    assert found is None or len(found) >= 7
    monkeypatch.setenv("PATH", "")  # no git
    record.commit.cache_clear()
    assert record.commit() is None
    record.commit.cache_clear()


def test_record_names_the_failed_constraint(door_plan: vkc.Plan) -> None:
    violation = vkc.Violation("penetration", "forearm_link – sofa", detail="overlap by 30 mm")
    plan = dataclasses.replace(door_plan, report=vkc.Report((violation,)), status="rejected")
    trial = record.trial(plan, method="VKC", seed=0, task="whole")
    assert (trial["success"], trial["task"]) == (False, "whole")
    assert trial["failed_constraint"] == "penetration forearm_link – sofa"
    assert trial["violations"] == [str(violation)]
    late = dataclasses.replace(door_plan, status="time limit")
    assert record.trial(late, method="VKC", seed=0)["failed_constraint"] == "time limit"
