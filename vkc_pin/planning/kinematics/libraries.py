"""The folder in which compiled functions are kept from process to process: owner-only, checked before use, bounded."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
import stat
import time
from pathlib import Path

from vkc_pin.utils.disk_cache import TEMPORARY, VARIABLE, folder, only_mine, write_whole

__all__ = ["BUILD", "VARIABLE", "Libraries"]

BUILD = ".build-"
"""Start of the names of folders in which libraries are compiled."""

_FILES, _BYTES = (
    256,
    512 * 2**20,
)  # libraries that are kept at most, and records; a waypoint's functions take 0.1 MB
_JOBS = 64  # that wait at most
# [s] after which what could not be compiled is tried again, and what a dead process left is removed
_RETRY = 86400.0
# Names of the files and folders that the package creates here. No others are removed or run.
_RANDOM = "[a-z0-9_]{8}"  # end of a name of `tempfile`
_FILE = re.compile(rf"[0-9a-f]{{40}}\.(?:so|json|job|failed)|{re.escape(TEMPORARY)}{_RANDOM}")
_BUILD = re.compile(re.escape(BUILD) + _RANDOM)
_DIGEST = (
    hashlib.sha256().digest_size
)  # bytes after the end of a library: loaders do not look at them


class Libraries:
    """A folder with libraries `KEY.so`, wishes for more `KEY.job`, and marks `KEY.failed` of what could not be compiled.

    A library ends in a digest of all before it, so that one that was cut off is never loaded: that
    could kill the process. Files appear whole or not at all. Any number of processes may use the
    folder at once. What cannot be done raises OSError.

    Attributes:
        path: The folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def here(cls) -> Libraries | None:
        """Return this user's folder, made if need be; None if there is none, or if others might have written in it."""
        path = folder()
        return None if path is None else cls(path)

    def exists(self, key: str) -> bool:
        """Whether there seems to be a library."""
        return (self.path / f"{key}.so").is_file()

    def find(self, key: str) -> Path | None:
        """Return a library that may be loaded; one that is damaged is removed."""
        path = self.path / f"{key}.so"
        try:
            with os.fdopen(
                os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC), "rb"
            ) as stream:
                status = os.fstat(stream.fileno())
                if not stat.S_ISREG(status.st_mode) or not only_mine(status):
                    return None
                data = stream.read()
        except OSError:
            return None
        if hashlib.sha256(data[:-_DIGEST]).digest() != data[-_DIGEST:]:
            self.remove(f"{key}.so")
            return None
        with contextlib.suppress(OSError):
            os.utime(path)  # when it was used last
        return path

    def ask(self, key: str, job: bytes) -> bool:
        """Ask for a library; return whether somebody should see to it now."""
        if self.failed(key):
            return False
        if key not in (jobs := self.jobs()):
            if len(jobs) >= _JOBS:
                return False
            self._write(f"{key}.job", job)
        return True

    def jobs(self) -> list[str]:
        """Return the keys of what was asked for and is not there yet."""
        found = (path for path in self.path.glob("*.job") if _FILE.fullmatch(path.name))
        return sorted(path.stem for path in found if path.is_file() and not path.is_symlink())

    def job(self, key: str) -> bytes:
        """Return what was asked for."""
        path = self.path / f"{key}.job"
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC), "rb") as stream:
            if not only_mine(os.fstat(stream.fileno())):
                raise PermissionError(f"others may have written {path}")
            return stream.read()

    def failed(self, key: str) -> bool:
        """Whether it was tried within the last day, without success."""
        with contextlib.suppress(OSError):
            return time.time() - (self.path / f"{key}.failed").stat().st_mtime < _RETRY
        return False

    def try_out(self, key: str) -> None:
        """Note that it is being tried: it has failed unless `publish` follows, even if this process dies of it."""
        self._write(f"{key}.failed", b"")

    def publish(self, key: str, library: bytes) -> None:
        """Keep a library."""
        self._write(f"{key}.so", library + hashlib.sha256(library).digest())
        self.remove(f"{key}.failed")

    def remove(self, name: str) -> None:
        """Remove a file, if it is there."""
        with contextlib.suppress(OSError):
            (self.path / name).unlink()

    def tidy(self) -> None:
        """Remove the least recently used files beyond the limits, and files of processes that died.

        Only regular files and build folders with names that the package creates are removed.
        """
        libraries, now = [], time.time()
        for path in self.path.iterdir():
            with contextlib.suppress(OSError):
                status = path.lstat()
                is_old = now - status.st_mtime > _RETRY
                if stat.S_ISREG(status.st_mode) and _FILE.fullmatch(path.name):
                    if path.suffix in (".so", ".json"):
                        libraries.append((status.st_mtime, status.st_size, path))
                    elif is_old:
                        path.unlink()
                elif stat.S_ISDIR(status.st_mode) and _BUILD.fullmatch(path.name) and is_old:
                    shutil.rmtree(path)  # does not follow links
        size = 0
        for count, (_, nbytes, path) in enumerate(sorted(libraries, reverse=True)):
            size += nbytes
            if count >= _FILES or size > _BYTES:
                self.remove(path.name)

    def lock(self) -> int | None:
        """Return the handle of the lock that whoever compiles has, or None if somebody has it; to be closed.

        A process that inherits the handle has the lock as well, as long as one of them has it open.
        """
        handle = os.open(
            self.path / "lock", os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600
        )
        try:
            if self.take(handle):
                return handle
        except OSError:
            os.close(handle)
            raise
        os.close(handle)
        return None

    def take(self, handle: int) -> bool:
        """Take the lock, unless somebody has it."""
        import fcntl

        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True

    def unlock(self, handle: int) -> None:
        """Let go of the lock."""
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_UN)

    def _write(self, name: str, data: bytes) -> None:
        write_whole(self.path / name, data)
