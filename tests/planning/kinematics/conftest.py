"""Provides an empty folder of compiled functions."""

from __future__ import annotations

from pathlib import Path

import pytest

from vkc_pin.planning.kinematics import machine_code
from vkc_pin.planning.kinematics.machine_code import Libraries
from vkc_pin.utils.disk_cache import CACHE_VARIABLE


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Libraries:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(machine_code, "_NICENESS", 0)  # other tests run beside these
    found = Libraries.open_default()
    assert found is not None
    return found
