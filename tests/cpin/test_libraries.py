"""The folder of compiled functions: only its owner's files are used, whole ones, and not too many."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from vkc_pin.cpin import libraries
from vkc_pin.cpin.libraries import VARIABLE, Libraries

LIBRARY = bytes(range(256)) * 40


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Libraries:
    monkeypatch.setenv(VARIABLE, str(tmp_path / "cache"))
    found = Libraries.here()
    assert found is not None
    return found


def names(folder: Libraries) -> list[str]:
    return sorted(path.name for path in folder.path.iterdir())


def age(path: Path, seconds: float) -> None:
    os.utime(path, (time.time() - seconds,) * 2)


def test_where_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def here() -> Path | None:
        found = Libraries.here()
        return found.path if found else None

    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for off in ("", "off", " OFF "):
        monkeypatch.setenv(VARIABLE, off)
        assert here() is None
    assert not (tmp_path / "home").exists()
    monkeypatch.setenv(VARIABLE, str(tmp_path / "deep" / "own"))
    assert here() == tmp_path / "deep" / "own"
    assert (tmp_path / "deep" / "own").stat().st_mode & 0o777 == 0o700
    monkeypatch.setenv(VARIABLE, "~/mine")
    assert here() == tmp_path / "home" / "mine"
    monkeypatch.delenv(VARIABLE)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    assert here() == tmp_path / "home" / ".cache" / "vkc_pin"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert here() == tmp_path / "home" / ".cache" / "vkc_pin"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert here() == tmp_path / "xdg" / "vkc_pin"


def test_a_folder_in_which_others_may_write_is_not_used(folder: Libraries, monkeypatch: pytest.MonkeyPatch) -> None:
    for mode, used in ((0o700, True), (0o755, True), (0o770, False), (0o777, False), (0o702, False)):
        folder.path.chmod(mode)
        assert (Libraries.here() is not None) == used, oct(mode)
    folder.path.chmod(0o700)
    monkeypatch.setattr(os, "geteuid", lambda: folder.path.stat().st_uid + 1)
    assert Libraries.here() is None, "it is somebody else's"


def test_what_is_no_folder_is_not_used(tmp_path: Path, folder: Libraries, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "link").symlink_to(folder.path)
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "link", tmp_path / "file", tmp_path / "file" / "cache", Path("/proc/nowhere")):
        monkeypatch.setenv(VARIABLE, str(place))
        assert Libraries.here() is None, place


def test_what_was_published_is_found(folder: Libraries) -> None:
    assert not folder.exists("a")
    assert folder.find("a") is None
    folder.try_out("a")
    assert folder.failed("a")
    folder.publish("a", LIBRARY)
    assert not folder.failed("a")
    assert folder.exists("a")
    path = folder.find("a")
    assert path is not None
    assert path.read_bytes().startswith(LIBRARY)
    assert names(folder) == ["a.so"]
    assert path.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("size", [0, 1, 31, 32, 5000, len(LIBRARY), len(LIBRARY) + 31])
def test_a_library_that_was_cut_off_is_removed(folder: Libraries, size: int) -> None:
    folder.publish("a", LIBRARY)
    path = folder.path / "a.so"
    path.write_bytes(path.read_bytes()[:size])
    assert folder.find("a") is None
    assert names(folder) == []


def test_a_library_that_changed_is_removed(folder: Libraries) -> None:
    folder.publish("a", LIBRARY)
    data = bytearray((folder.path / "a.so").read_bytes())
    data[100] ^= 1
    (folder.path / "a.so").write_bytes(data)
    assert folder.find("a") is None
    assert names(folder) == []


def test_a_library_that_others_may_have_written_is_not_used(folder: Libraries, monkeypatch: pytest.MonkeyPatch) -> None:
    folder.publish("a", LIBRARY)
    path = folder.path / "a.so"
    path.chmod(0o620)
    assert folder.find("a") is None
    path.chmod(0o600)
    assert folder.find("a") is not None
    (folder.path / "b.so").symlink_to(path)
    assert folder.find("b") is None, "a link may lead anywhere"
    monkeypatch.setattr(os, "geteuid", lambda: path.stat().st_uid + 1)
    assert folder.find("a") is None


def test_wishes(folder: Libraries, monkeypatch: pytest.MonkeyPatch) -> None:
    assert folder.jobs() == []
    assert folder.ask("b", b"what")
    assert folder.ask("a", b"more")
    assert folder.ask("b", b"again"), "somebody should see to it, if only because the first who should is dead"
    assert folder.jobs() == ["a", "b"]
    assert folder.job("b") == b"what"
    (folder.path / "b.job").chmod(0o606)
    with pytest.raises(PermissionError, match="others"):
        folder.job("b")
    monkeypatch.setattr(libraries, "_JOBS", 2)
    assert not folder.ask("c", b"too many")
    assert folder.jobs() == ["a", "b"]


def test_what_failed_is_tried_again_after_a_day(folder: Libraries) -> None:
    folder.try_out("a")
    assert not folder.ask("a", b"what")
    age(folder.path / "a.failed", 80000)
    assert not folder.ask("a", b"what")
    age(folder.path / "a.failed", 90000)
    assert folder.ask("a", b"what")
    assert folder.job("a") == b"what"


def test_libraries_that_were_not_used_for_long_go_first(folder: Libraries, monkeypatch: pytest.MonkeyPatch) -> None:
    for index, key in enumerate("abcde"):
        folder.publish(key, LIBRARY)
        age(folder.path / f"{key}.so", 1000 - 100 * index)
    assert folder.find("a") is not None, "used now"
    monkeypatch.setattr(libraries, "_FILES", 4)
    folder.tidy()
    assert names(folder) == ["a.so", "c.so", "d.so", "e.so"]
    monkeypatch.setattr(libraries, "_BYTES", 2.5 * len(LIBRARY))
    folder.tidy()
    assert names(folder) == ["a.so", "e.so"]


def test_what_dead_processes_left_goes_after_a_day(folder: Libraries) -> None:
    lock = folder.lock()
    assert lock is not None
    os.close(lock)
    for name in ("x.job", "x.failed", ".half"):
        (folder.path / name).write_bytes(b"")
    (folder.path / ".build-1").mkdir()
    (folder.path / ".build-1" / "f.c").write_bytes(b"")
    folder.publish("a", LIBRARY)
    folder.tidy()
    everything = names(folder)
    assert len(everything) == 6
    for name in everything:
        age(folder.path / name, 90000)
    folder.tidy()
    assert names(folder) == ["a.so", "lock"]


def test_one_compiles_at_a_time(folder: Libraries) -> None:
    first = folder.lock()
    assert first is not None
    assert folder.lock() is None
    inherited = os.dup(first)
    os.close(first)
    assert folder.lock() is None, "the process that compiles has it"
    folder.unlock(inherited)
    second = folder.lock()
    assert second is not None
    assert not folder.take(inherited)
    os.close(second)
    assert folder.take(inherited)
    os.close(inherited)
    third = folder.lock()
    assert third is not None
    os.close(third)


def test_files_appear_whole_or_not_at_all(folder: Libraries, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: Path, target: Path) -> Path:
        raise OSError("no space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="no space"):
        folder.publish("a", LIBRARY)
    assert names(folder) == []
