"""Tests the choice of the number of threads."""

from __future__ import annotations

import os

import coal
import pytest

from vkc_pin.world.collision.distances import Shapes
from vkc_pin.world.collision.solids import count_threads


@pytest.mark.parametrize(
    ("requested", "expected"), [("1", 1), ("3", 3), ("0", 1), ("nonsense", 8), ("", 8)]
)
def test_thread_count_respects_cores_and_environment(
    requested: str, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", requested)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(12)), raising=False)
    assert count_threads() == expected
    assert Shapes([coal.Sphere(0.1)]).threads == expected
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0}, raising=False)
    assert count_threads() == 1
