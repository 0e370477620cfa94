"""Tests the folder of compiled functions: ownership, integrity and size limits."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import pytest

from vkc_pin.planning.kinematics import machine_code
from vkc_pin.planning.kinematics.machine_code import BUILD, Libraries, compile_jobs
from vkc_pin.utils.disk_cache import CACHE_VARIABLE, TEMPORARY_PREFIX

LIBRARY = bytes(range(256)) * 40


A, B, C, D, E = (digit * 40 for digit in "abcde")


def list_names(folder: Libraries) -> list[str]:
    return sorted(path.name for path in folder.path.iterdir())


def read_tree(folder: Path) -> dict[str, bytes | None]:
    """Return every path below a folder, with the contents of files."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


def make_older(path: Path, seconds: float) -> None:
    os.utime(path, (time.time() - seconds,) * 2)


@pytest.mark.parametrize(
    ("named", "xdg", "expected"),
    [
        *((off, None, None) for off in ("", "off", " OFF ")),
        ("{}/deep/own", None, "deep/own"),
        ("~/mine", None, "home/mine"),
        (None, None, "home/.cache"),
        (None, "relative", "home/.cache"),
        (None, "{}/xdg", "xdg"),
    ],
)
def test_default_folder_follows_the_environment(
    named: str | None,
    xdg: str | None,
    expected: str | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for variable, value in ((CACHE_VARIABLE, named), ("XDG_CACHE_HOME", xdg)):
        monkeypatch.delenv(variable, raising=False)
        if value is not None:
            monkeypatch.setenv(variable, value.format(tmp_path))
    found = Libraries.open_default()
    if expected is None:
        assert found is None
        assert not (tmp_path / "home").exists()
        return
    assert found is not None
    assert found.path == tmp_path / expected / "vkc_pin"
    for created in (found.path, found.path.parent):
        assert created.stat().st_mode & 0o777 == 0o700 or named is None


def test_unsafe_folders_are_not_used(
    tmp_path: Path, folder: Libraries, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Folders that other users can write to, and symbolic links, are unsafe."""
    for path in (folder.path, folder.path.parent):
        for mode in (0o755, 0o770, 0o777, 0o702, 0o700):
            path.chmod(mode)
            assert (Libraries.open_default() is not None) == (mode in (0o700, 0o755)), oct(mode)
    with monkeypatch.context() as patch:
        patch.setattr(os, "geteuid", lambda: folder.path.stat().st_uid + 1)
        assert Libraries.open_default() is None
    (tmp_path / "link").symlink_to(folder.path)
    (tmp_path / "file").write_text("")
    (tmp_path / "around").mkdir(mode=0o700)
    (tmp_path / "around" / "vkc_pin").symlink_to(folder.path)
    for name in ("link", "file", "file/cache", "around", "/proc/nowhere"):
        monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / name))
        assert Libraries.open_default() is None, name


def test_published_libraries_are_found(folder: Libraries) -> None:
    assert not folder.exists(A)
    assert folder.find(A) is None
    folder.mark_attempt(A)
    assert folder.has_failed(A)
    folder.publish(A, LIBRARY)
    assert not folder.has_failed(A)
    assert folder.exists(A)
    path = folder.find(A)
    assert path is not None
    assert path.read_bytes().startswith(LIBRARY)
    assert list_names(folder) == [f"{A}.so"]
    assert path.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("size", [0, 31, 32, 5000, len(LIBRARY) + 31, None])
def test_damaged_library_is_removed(folder: Libraries, size: int | None) -> None:
    """The file is truncated, or one of its bits is flipped."""
    folder.publish(A, LIBRARY)
    path = folder.path / f"{A}.so"
    data = path.read_bytes()
    path.write_bytes(bytes([data[0] ^ 1]) + data[1:] if size is None else data[:size])
    assert folder.find(A) is None
    assert list_names(folder) == []


def test_links_and_files_of_other_users_are_not_used(
    folder: Libraries, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder.publish(A, LIBRARY)
    path = folder.path / f"{A}.so"
    (folder.path / f"{B}.so").symlink_to(path)
    assert folder.find(B) is None
    with monkeypatch.context() as patch:
        patch.setattr(os, "geteuid", lambda: path.stat().st_uid + 1)
        assert folder.find(A) is None
    path.chmod(0o620)
    assert folder.find(A) is None
    folder.request(C, b"job")
    (folder.path / f"{C}.job").chmod(0o606)
    with pytest.raises(PermissionError, match="others"):
        folder.read_job(C)


def test_requests_are_listed_up_to_a_maximum_number(folder: Libraries) -> None:
    for key in (B, A, B):  # a repeated request is pending, too: the first worker may be dead
        assert folder.request(key, b"job")
    assert folder.list_jobs() == [A, B]
    assert folder.read_job(B) == b"job"
    accepted = [folder.request(f"{k:040x}", b"job") for k in range(100)]
    assert accepted == sorted(accepted, reverse=True)
    assert 10 < sum(accepted) < 100


def test_failed_compilation_is_retried_after_a_day(folder: Libraries) -> None:
    folder.mark_attempt(A)
    assert not folder.request(A, b"what")
    make_older(folder.path / f"{A}.failed", 80000)
    assert not folder.request(A, b"what")
    make_older(folder.path / f"{A}.failed", 90000)
    assert folder.request(A, b"what")
    assert folder.read_job(A) == b"what"


def test_least_recently_used_libraries_are_evicted_first(
    folder: Libraries, monkeypatch: pytest.MonkeyPatch
) -> None:
    for index, key in enumerate([A, B, C, D, E]):
        folder.publish(key, LIBRARY)
        make_older(folder.path / f"{key}.so", 1000 - 100 * index)
    assert folder.find(A) is not None
    monkeypatch.setattr(machine_code, "_MAX_FILES", 4)
    folder.evict()
    assert list_names(folder) == [f"{A}.so", f"{C}.so", f"{D}.so", f"{E}.so"]
    monkeypatch.setattr(machine_code, "_MAX_BYTES", 2.5 * len(LIBRARY))
    folder.evict()
    assert list_names(folder) == [f"{A}.so", f"{E}.so"]


def test_files_of_dead_processes_are_removed_after_a_day(folder: Libraries) -> None:
    lock = folder.lock()
    assert lock is not None
    os.close(lock)
    handle, _ = tempfile.mkstemp(dir=folder.path, prefix=TEMPORARY_PREFIX)
    os.close(handle)
    for name in (f"{B}.job", f"{B}.failed"):
        (folder.path / name).write_bytes(b"")
    build = Path(tempfile.mkdtemp(dir=folder.path, prefix=BUILD))
    (build / "f.c").write_bytes(b"")
    folder.publish(A, LIBRARY)
    folder.evict()
    names = list_names(folder)
    assert len(names) == 6
    for name in names:
        make_older(folder.path / name, 90000)
    folder.evict()
    assert list_names(folder) == [f"{A}.so", "lock"]


FOREIGN = (
    *("notes.txt", "thesis/1.tex", ".git/config", "tmp12345678/data", "lock.txt", "tmp"),
    *("a.so", "data.json", "print.job", f"{A[:-1]}.so", f"{A}0.json", f"{A.upper()}.so"),
    *(f"{A}.txt", f"x{A}.so", f".{A}.so", f"{B}.so/inside", f"{B}.job/inside"),
    *(".build-1/f.c", ".build-abcdefgh.txt", ".new-1", ".new-abcdefgh.txt"),
)
"""Files that the package never creates in its cache, some with similar names."""


def test_foreign_files_are_neither_removed_nor_compiled(
    folder: Libraries, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both in the folder that the variable names and in the cache folder within it."""
    monkeypatch.setattr(machine_code, "_MAX_FILES", 2)
    monkeypatch.setattr(machine_code, "_MAX_BYTES", 100)
    for place in (folder.path.parent, folder.path):
        for name in FOREIGN:
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            (place / name).write_text(name)
        for path in place.rglob("*"):
            make_older(path, 1e6)
    before = read_tree(folder.path.parent)
    assert len(before) > 2 * len(FOREIGN)
    assert Libraries.open_default() is not None
    lock = folder.lock()
    assert lock is not None
    compile_jobs(str(folder.path), lock)
    os.close(lock)
    (folder.path / "lock").unlink()
    assert read_tree(folder.path.parent) == before


def test_eviction_does_not_follow_links(folder: Libraries, tmp_path: Path) -> None:
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "file").write_text("mine")
    build = Path(tempfile.mkdtemp(dir=folder.path, prefix=BUILD))
    links = [folder.path / f"{BUILD}abcdefgh", folder.path / f"{A}.so", folder.path / f"{B}.job"]
    for link in (*links, build / "link"):
        link.symlink_to(tmp_path / "outside")
        os.utime(link, (0.0, 0.0), follow_symlinks=False)
    make_older(build, 90000)
    folder.evict()
    assert (tmp_path / "outside" / "file").read_text() == "mine"
    assert list_names(folder) == sorted(link.name for link in links)


def test_only_one_process_compiles(folder: Libraries) -> None:
    first = folder.lock()
    assert first is not None
    assert folder.lock() is None
    inherited = os.dup(first)
    os.close(first)
    assert folder.lock() is None
    folder.unlock(inherited)
    second = folder.lock()
    assert second is not None
    assert not folder.acquire(inherited)
    os.close(second)
    assert folder.acquire(inherited)
    os.close(inherited)


def test_failed_write_leaves_no_file(folder: Libraries, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: Path, target: Path) -> Path:
        raise OSError("no space left on device")

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(OSError, match="no space"):
        folder.publish(A, LIBRARY)
    assert list_names(folder) == []
