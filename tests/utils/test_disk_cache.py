"""Tests that records on disk are exact, and are rebuilt if damaged or foreign."""

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
def cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(disk_cache.CACHE_VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache" / "vkc_pin"


def fail_to_build() -> None:
    raise AssertionError("the record exists")


@given(key=st.binary(), data=PLAIN)
@settings(
    max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_records_round_trip(cache_folder: Path, key: bytes, data: object) -> None:
    for file in cache_folder.glob("*.json"):
        file.unlink()
    assert disk_cache.load_or_build(key, lambda: data) == data
    (file,) = cache_folder.iterdir()
    assert file.stat().st_mode & 0o777 == 0o600
    assert disk_cache.load_or_build(key, fail_to_build) == data
    assert disk_cache.load_or_build(key + b"x", lambda: "other") == "other"


@pytest.mark.parametrize("damage", ["cut", "changed", "writable", "link", "folder"])
def test_damaged_and_foreign_records_are_rebuilt(
    cache_folder: Path, tmp_path: Path, damage: str
) -> None:
    assert disk_cache.load_or_build(b"key", lambda: [1.5, "a"]) == [1.5, "a"]
    (file,) = cache_folder.iterdir()
    if damage == "cut":
        file.write_bytes(file.read_bytes()[:-1])
    elif damage == "changed":
        file.write_bytes(file.read_bytes().replace(b"1.5", b"2.5"))
    elif damage == "writable":
        file.chmod(0o666)
    elif damage == "link":
        file.rename(tmp_path / "elsewhere")
        file.symlink_to(tmp_path / "elsewhere")
    else:
        cache_folder.chmod(0o777)
    assert disk_cache.load_or_build(b"key", lambda: "new") == "new"


def test_cache_can_be_disabled(cache_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(disk_cache.CACHE_VARIABLE, "off")
    assert [disk_cache.load_or_build(b"key", lambda count=count: count) for count in (1, 2)] == [
        1,
        2,
    ]  # type: ignore[misc]
    assert not cache_folder.exists()


def test_failed_writes_do_not_raise(cache_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def raise_no_space(*_: object) -> None:
        raise OSError("no space left")

    disk_cache.load_or_build(b"other", lambda: 1)
    monkeypatch.setattr(os, "fdopen", raise_no_space)
    assert disk_cache.load_or_build(b"key", lambda: 2) == 2
