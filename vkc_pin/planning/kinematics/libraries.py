"""Stores compiled functions in a folder of the user, checked before loading and bounded in size."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
import stat
import time
from pathlib import Path
from typing import BinaryIO

from vkc_pin.utils.disk_cache import (
    CACHE_VARIABLE,
    TEMPORARY_PREFIX,
    find_cache_folder,
    is_private,
    write_private_file,
)

__all__ = ["BUILD", "CACHE_VARIABLE", "Libraries"]

BUILD = ".build-"
"""Start of the names of folders in which libraries are compiled."""

# maximum number and size of libraries and records; a waypoint's functions take 0.1 MB
_MAX_FILES, _MAX_BYTES = 256, 512 * 2**20
_MAX_JOBS = 64  # maximum number of pending jobs
# [s] after which a failed compilation is retried and the files of dead processes are removed
_RETRY_DELAY = 86400.0
# Names of the files and folders that the package creates here. No others are removed or executed.
_RANDOM_SUFFIX = "[a-z0-9_]{8}"  # suffix of names by `tempfile`
_FILE_PATTERN = re.compile(
    rf"[0-9a-f]{{40}}\.(?:so|json|job|failed)|{re.escape(TEMPORARY_PREFIX)}{_RANDOM_SUFFIX}"
)
_BUILD_PATTERN = re.compile(re.escape(BUILD) + _RANDOM_SUFFIX)
_DIGEST_SIZE = hashlib.sha256().digest_size  # bytes appended to a library; loaders ignore them


class Libraries:
    """A folder with libraries `KEY.so`, requests `KEY.job` and failure marks `KEY.failed`.

    A library ends in a digest, so that a truncated one, which could crash the process, is never
    loaded. Any number of processes may use the folder at once. Operations that fail raise OSError.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def open_default(cls) -> Libraries | None:
        """Return this user's folder, created if necessary.

        Returns None if there is none, or if other users might have written to it.
        """
        path = find_cache_folder()
        return None if path is None else cls(path)

    def exists(self, key: str) -> bool:
        """Return whether a file of the library exists."""
        return (self.path / f"{key}.so").is_file()

    def find(self, key: str) -> Path | None:
        """Return the path of a valid library, or None; a damaged one is removed."""
        path = self.path / f"{key}.so"
        try:
            with _open(path) as stream:
                status = os.fstat(stream.fileno())
                if not stat.S_ISREG(status.st_mode) or not is_private(status):
                    return None
                data = stream.read()
        except OSError:
            return None
        if hashlib.sha256(data[:-_DIGEST_SIZE]).digest() != data[-_DIGEST_SIZE:]:
            self.remove(f"{key}.so")
            return None
        with contextlib.suppress(OSError):
            os.utime(path)  # time of last use
        return path

    def request(self, key: str, job: bytes) -> bool:
        """Request the compilation of a library; return whether it is pending now."""
        if self.has_failed(key):
            return False
        if key not in (pending := self.list_jobs()):
            if len(pending) >= _MAX_JOBS:
                return False
            self._write(f"{key}.job", job)
        return True

    def list_jobs(self) -> list[str]:
        """Return the keys of pending jobs."""
        found = (path for path in self.path.glob("*.job") if _FILE_PATTERN.fullmatch(path.name))
        return sorted(path.stem for path in found if path.is_file() and not path.is_symlink())

    def read_job(self, key: str) -> bytes:
        """Return the contents of a pending job."""
        path = self.path / f"{key}.job"
        with _open(path) as stream:
            if not is_private(os.fstat(stream.fileno())):
                raise PermissionError(f"others may have written {path}")
            return stream.read()

    def has_failed(self, key: str) -> bool:
        """Return whether a compilation failed within the last day."""
        with contextlib.suppress(OSError):
            return time.time() - (self.path / f"{key}.failed").stat().st_mtime < _RETRY_DELAY
        return False

    def mark_attempt(self, key: str) -> None:
        """Mark a compilation as failed until `publish` is called, as it may crash the process."""
        self._write(f"{key}.failed", b"")

    def publish(self, key: str, library: bytes) -> None:
        """Store a library."""
        self._write(f"{key}.so", library + hashlib.sha256(library).digest())
        self.remove(f"{key}.failed")

    def remove(self, name: str) -> None:
        """Remove a file if it exists."""
        with contextlib.suppress(OSError):
            (self.path / name).unlink()

    def evict(self) -> None:
        """Remove the least recently used files beyond the limits, and files of dead processes.

        Only regular files and build folders with names that the package creates are removed.
        """
        libraries, now = [], time.time()
        for path in self.path.iterdir():
            with contextlib.suppress(OSError):
                status = path.lstat()
                is_old = now - status.st_mtime > _RETRY_DELAY
                if stat.S_ISREG(status.st_mode) and _FILE_PATTERN.fullmatch(path.name):
                    if path.suffix in (".so", ".json"):
                        libraries.append((status.st_mtime, status.st_size, path))
                    elif is_old:
                        path.unlink()
                elif (
                    stat.S_ISDIR(status.st_mode) and _BUILD_PATTERN.fullmatch(path.name) and is_old
                ):
                    shutil.rmtree(path)  # does not follow symbolic links
        size = 0
        for count, (_, nbytes, path) in enumerate(sorted(libraries, reverse=True)):
            size += nbytes
            if count >= _MAX_FILES or size > _MAX_BYTES:
                self.remove(path.name)

    def lock(self) -> int | None:
        """Return a handle of the compiler lock, to be closed, or None if another process holds it.

        A process that inherits the handle holds the lock too, as long as either has it open.
        """
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
        handle = os.open(self.path / "lock", flags, 0o600)
        try:
            if self.acquire(handle):
                return handle
        except OSError:
            os.close(handle)
            raise
        os.close(handle)
        return None

    def acquire(self, handle: int) -> bool:
        """Try to acquire the lock; return whether that succeeded."""
        import fcntl

        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True

    def unlock(self, handle: int) -> None:
        """Release the lock."""
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_UN)

    def _write(self, name: str, data: bytes) -> None:
        write_private_file(self.path / name, data)


def _open(path: Path) -> BinaryIO:
    """Open a file, but no symbolic link, for reading."""
    return os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC), "rb")
