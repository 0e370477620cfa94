"""Records say of which commit the sources are."""

from __future__ import annotations

import pytest

from vkc_pin.benchmarks.harness import record


def test_the_commit(monkeypatch: pytest.MonkeyPatch) -> None:
    record.commit.cache_clear()
    found = record.commit()
    assert found is None or len(found) >= 7
    monkeypatch.setenv("PATH", "")  # no git
    record.commit.cache_clear()
    assert record.commit() is None
    record.commit.cache_clear()
