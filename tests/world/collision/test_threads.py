"""As many threads as there are cores, or as is said."""

from __future__ import annotations

import os

import coal
import pytest

from vkc_pin.world.collision.shapes import Shapes
from vkc_pin.world.collision.threads import count_threads


@pytest.mark.parametrize(("said", "most"), [("1", 1), ("3", 3), ("0", 1), ("nonsense", 8), ("", 8)])
def test_threads(said: str, most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", said)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(12)), raising=False)
    assert count_threads() == most
    shapes = Shapes([coal.Sphere(0.1)])
    assert [shapes._threads(rows) for rows in (0, 10, 10**6)] == [1, 1, most]
    assert Shapes([coal.Sphere(0.1)], threads=5)._threads(10**6) == 5
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0}, raising=False)
    assert count_threads() == 1
