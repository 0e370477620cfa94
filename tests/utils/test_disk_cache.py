"""Tests that records on disk are exact, and rebuilt where they cannot be trusted."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from vkc_pin.utils import disk_cache

PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=10,
)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(disk_cache.CACHE_VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache" / "vkc_pin"


def fail() -> None:
    raise AssertionError("it is there")


@given(key=st.binary(), data=PLAIN)
@settings(
    max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_records_round_trip(here: Path, key: bytes, data: object) -> None:
    for file in here.glob("*.json"):
        file.unlink()
    assert disk_cache.load_or_build(key, lambda: data) == data
    (file,) = here.iterdir()
    assert file.stat().st_mode & 0o777 == 0o600
    assert disk_cache.load_or_build(key, fail) == data
    assert disk_cache.load_or_build(key + b"x", lambda: "other") == "other"


@pytest.mark.parametrize("harm", ["cut", "changed", "writable", "link", "folder"])
def test_damaged_and_foreign_records_are_rebuilt(here: Path, tmp_path: Path, harm: str) -> None:
    assert disk_cache.load_or_build(b"key", lambda: [1.5, "a"]) == [1.5, "a"]
    (file,) = here.iterdir()
    if harm == "cut":
        file.write_bytes(file.read_bytes()[:-1])
    elif harm == "changed":
        file.write_bytes(file.read_bytes().replace(b"1.5", b"2.5"))
    elif harm == "writable":
        file.chmod(0o666)
    elif harm == "link":
        file.rename(tmp_path / "elsewhere")
        file.symlink_to(tmp_path / "elsewhere")
    else:
        here.chmod(0o777)
    assert disk_cache.load_or_build(b"key", lambda: "new") == "new"


def test_the_cache_can_be_disabled(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(disk_cache.CACHE_VARIABLE, "off")
    assert [disk_cache.load_or_build(b"key", lambda count=count: count) for count in (1, 2)] == [
        1,
        2,
    ]  # type: ignore[misc]
    assert not here.exists()


def test_failed_writes_do_not_raise(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError("no space left")

    disk_cache.load_or_build(b"other", lambda: 1)
    monkeypatch.setattr(os, "fdopen", full)
    assert disk_cache.load_or_build(b"key", lambda: 2) == 2
