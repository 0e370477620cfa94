"""Tests the folder of compiled functions: ownership, integrity and size limits."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import pytest

from vkc_pin.planning.kinematics import libraries
from vkc_pin.planning.kinematics.libraries import BUILD, CACHE_VARIABLE, Libraries
from vkc_pin.planning.kinematics.machine_code import compile_jobs
from vkc_pin.utils.disk_cache import TEMPORARY_PREFIX

LIBRARY = bytes(range(256)) * 40


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Libraries:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    found = Libraries.open_default()
    assert found is not None
    return found


A, B, C, D, E = (digit * 40 for digit in "abcde")


def names(folder: Libraries) -> list[str]:
    return sorted(path.name for path in folder.path.iterdir())


def tree(folder: Path) -> dict[str, bytes | None]:
    """Return every path below a folder, with the contents of files."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


def age(path: Path, seconds: float) -> None:
    os.utime(path, (time.time() - seconds,) * 2)


def test_default_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def here() -> Path | None:
        found = Libraries.open_default()
        return found.path if found else None

    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for off in ("", "off", " OFF "):
        monkeypatch.setenv(CACHE_VARIABLE, off)
        assert here() is None
    assert not (tmp_path / "home").exists()
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "deep" / "own"))
    assert here() == tmp_path / "deep" / "own" / "vkc_pin"
    for made in (tmp_path / "deep" / "own", tmp_path / "deep" / "own" / "vkc_pin"):
        assert made.stat().st_mode & 0o777 == 0o700
    monkeypatch.setenv(CACHE_VARIABLE, "~/mine")
    assert here() == tmp_path / "home" / "mine" / "vkc_pin"
    monkeypatch.delenv(CACHE_VARIABLE)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    assert here() == tmp_path / "home" / ".cache" / "vkc_pin"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert here() == tmp_path / "home" / ".cache" / "vkc_pin"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert here() == tmp_path / "xdg" / "vkc_pin"


def test_a_folder_in_which_others_may_write_is_not_used(
    folder: Libraries, monkeypatch: pytest.MonkeyPatch
) -> None:
    for path in (folder.path, folder.path.parent):
        for mode, used in (
            (0o700, True),
            (0o755, True),
            (0o770, False),
            (0o777, False),
            (0o702, False),
        ):
            path.chmod(mode)
            assert (Libraries.open_default() is not None) == used, oct(mode)
        path.chmod(0o700)
    monkeypatch.setattr(os, "geteuid", lambda: folder.path.stat().st_uid + 1)
    assert Libraries.open_default() is None, "it is somebody else's"


def test_paths_that_are_no_folder_are_not_used(
    tmp_path: Path, folder: Libraries, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "link").symlink_to(folder.path)
    (tmp_path / "file").write_text("")
    for place in (
        tmp_path / "link",
        tmp_path / "file",
        tmp_path / "file" / "cache",
        Path("/proc/nowhere"),
    ):
        monkeypatch.setenv(CACHE_VARIABLE, str(place))
        assert Libraries.open_default() is None, place
    (tmp_path / "around").mkdir(mode=0o700)
    (tmp_path / "around" / "vkc_pin").symlink_to(folder.path)
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "around"))
    assert Libraries.open_default() is None


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
    assert names(folder) == [f"{A}.so"]
    assert path.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("size", [0, 1, 31, 32, 5000, len(LIBRARY), len(LIBRARY) + 31])
def test_truncated_library_is_removed(folder: Libraries, size: int) -> None:
    folder.publish(A, LIBRARY)
    path = folder.path / f"{A}.so"
    path.write_bytes(path.read_bytes()[:size])
    assert folder.find(A) is None
    assert names(folder) == []


def test_modified_library_is_removed(folder: Libraries) -> None:
    folder.publish(A, LIBRARY)
    data = bytearray((folder.path / f"{A}.so").read_bytes())
    data[100] ^= 1
    (folder.path / f"{A}.so").write_bytes(data)
    assert folder.find(A) is None
    assert names(folder) == []


def test_a_library_that_others_may_have_written_is_not_used(
    folder: Libraries, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder.publish(A, LIBRARY)
    path = folder.path / f"{A}.so"
    path.chmod(0o620)
    assert folder.find(A) is None
    path.chmod(0o600)
    assert folder.find(A) is not None
    (folder.path / f"{B}.so").symlink_to(path)
    assert folder.find(B) is None, "a link may lead anywhere"
    monkeypatch.setattr(os, "geteuid", lambda: path.stat().st_uid + 1)
    assert folder.find(A) is None


def test_requests(folder: Libraries, monkeypatch: pytest.MonkeyPatch) -> None:
    assert folder.list_jobs() == []
    assert folder.request(B, b"what")
    assert folder.request(A, b"more")
    assert folder.request(B, b"again"), (
        "somebody should see to it, if only because the first who should is dead"
    )
    assert folder.list_jobs() == [A, B]
    assert folder.read_job(B) == b"what"
    (folder.path / f"{B}.job").chmod(0o606)
    with pytest.raises(PermissionError, match="others"):
        folder.read_job(B)
    monkeypatch.setattr(libraries, "_MAX_JOBS", 2)
    assert not folder.request(C, b"too many")
    assert folder.list_jobs() == [A, B]


def test_failed_compilation_is_retried_after_a_day(folder: Libraries) -> None:
    folder.mark_attempt(A)
    assert not folder.request(A, b"what")
    age(folder.path / f"{A}.failed", 80000)
    assert not folder.request(A, b"what")
    age(folder.path / f"{A}.failed", 90000)
    assert folder.request(A, b"what")
    assert folder.read_job(A) == b"what"


def test_least_recently_used_libraries_are_evicted_first(
    folder: Libraries, monkeypatch: pytest.MonkeyPatch
) -> None:
    for index, key in enumerate([A, B, C, D, E]):
        folder.publish(key, LIBRARY)
        age(folder.path / f"{key}.so", 1000 - 100 * index)
    assert folder.find(A) is not None, "used now"
    monkeypatch.setattr(libraries, "_MAX_FILES", 4)
    folder.evict()
    assert names(folder) == [f"{A}.so", f"{C}.so", f"{D}.so", f"{E}.so"]
    monkeypatch.setattr(libraries, "_MAX_BYTES", 2.5 * len(LIBRARY))
    folder.evict()
    assert names(folder) == [f"{A}.so", f"{E}.so"]


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
    everything = names(folder)
    assert len(everything) == 6
    for name in everything:
        age(folder.path / name, 90000)
    folder.evict()
    assert names(folder) == [f"{A}.so", "lock"]


FOREIGN = (
    *(
        "notes.txt",
        "thesis/chapters/1.tex",
        ".git/config",
        ".profile",
        ".xsession",
        "tmp12345678/data",
        "lock.txt",
        "tmp",
    ),
    *(
        "a.so",
        "data.json",
        "print.job",
        "x.failed",
        f"{A[:-1]}.so",
        f"{A}0.json",
        f"{A.upper()}.so",
        f"{A}.txt",
        f"x{A}.so",
    ),
    *(
        f"{B}.so/inside",
        f"{B}.job/inside",
        ".build-1/f.c",
        ".build-abcdefgh.txt",
        ".new-1",
        ".new-abcdefgh.txt",
        f".{A}.so",
    ),
)
"""Files that the package never creates in its cache, some with names like those that it creates."""


def test_eviction_keeps_files_of_others(folder: Libraries, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both in the folder that the variable names, and in the cache's own folder."""
    monkeypatch.setattr(libraries, "_MAX_FILES", 2)
    monkeypatch.setattr(libraries, "_MAX_BYTES", 100)
    for place in (folder.path.parent, folder.path):
        for name in FOREIGN:
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            (place / name).write_text(name)
        for path in place.rglob("*"):
            age(path, 1e6)
    before = tree(folder.path.parent)
    assert len(before) > 2 * len(FOREIGN)
    folder.evict()
    assert tree(folder.path.parent) == before
    assert folder.list_jobs() == [], "none of them is compiled, and removed after that"


def test_eviction_does_not_follow_links(
    folder: Libraries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(libraries, "_MAX_FILES", 0)
    (tmp_path / "outside" / "deep").mkdir(parents=True)
    (tmp_path / "outside" / "deep" / "file").write_text("mine")
    build = Path(tempfile.mkdtemp(dir=folder.path, prefix=BUILD))
    links = [
        folder.path / f"{BUILD}abcdefgh",
        folder.path / f"{A}.so",
        folder.path / f"{B}.job",
        build / "link",
    ]
    for link in links:
        link.symlink_to(tmp_path / "outside")
        os.utime(link, (0.0, 0.0), follow_symlinks=False)
    age(build, 90000)
    before = tree(tmp_path / "outside")
    folder.evict()
    assert tree(tmp_path / "outside") == before
    assert not build.exists()
    assert names(folder) == sorted(link.name for link in links[:3])


def test_compiling_with_a_folder_that_has_other_files(
    folder: Libraries, monkeypatch: pytest.MonkeyPatch
) -> None:
    around = folder.path.parent
    for name in FOREIGN:
        (around / name).parent.mkdir(parents=True, exist_ok=True)
        (around / name).write_text(name)
    for path in around.rglob("*"):
        age(path, 1e6)
    before = tree(around)
    assert Libraries.open_default() is not None
    folder.request(A, b"not a job")
    lock = folder.lock()
    assert lock is not None
    compile_jobs(str(folder.path), lock)
    os.close(lock)
    assert names(folder) == [f"{A}.failed", "lock"], "it was tried"
    after = tree(around)
    assert {name: after[name] for name in after if not name.startswith("vkc_pin/")} == before


def test_only_one_process_compiles(folder: Libraries) -> None:
    first = folder.lock()
    assert first is not None
    assert folder.lock() is None
    inherited = os.dup(first)
    os.close(first)
    assert folder.lock() is None, "the process that compiles has it"
    folder.unlock(inherited)
    second = folder.lock()
    assert second is not None
    assert not folder.acquire(inherited)
    os.close(second)
    assert folder.acquire(inherited)
    os.close(inherited)
    third = folder.lock()
    assert third is not None
    os.close(third)


def test_files_are_written_atomically(folder: Libraries, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: Path, target: Path) -> Path:
        raise OSError("no space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="no space"):
        folder.publish(A, LIBRARY)
    assert names(folder) == []
