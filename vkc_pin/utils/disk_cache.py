"""What is kept on disk from process to process: the folder for it, and records in it that are found by what they depend on."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

__all__ = [
    "CACHE_VARIABLE",
    "TEMPORARY_PREFIX",
    "find_cache_folder",
    "is_private",
    "load_or_build",
    "write_private_file",
]

CACHE_VARIABLE = "VKC_PIN_CACHE"  # names the folder around the cache; empty or "off": no cache

TEMPORARY_PREFIX = ".new-"  # start of the names of incomplete files
_FOLDER_NAME = "vkc_pin"  # of the cache's own folder, apart from other files
_MAX_RECORD_SIZE = 2**24  # bytes of a record; those of the largest robots take some 10 kB


def find_cache_folder() -> Path | None:
    """Return this user's cache folder, creating it if necessary.

    Returns:
        The folder `vkc_pin` in the one that `VKC_PIN_CACHE` names, else in the user's cache folder.
        None if the cache is off, or if other users could write to it.
    """
    named = os.environ.get(CACHE_VARIABLE)
    if os.name != "posix" or (named is not None and named.strip().lower() in ("", "off")):
        return None
    try:
        if named is not None:
            above = Path(named).expanduser().absolute()
            above.mkdir(mode=0o700, parents=True, exist_ok=True)
            if not _is_private_folder(above):
                return None
        else:
            caches = Path(os.environ.get("XDG_CACHE_HOME", ""))
            above = caches if caches.is_absolute() else Path.home() / ".cache"
        path = above / _FOLDER_NAME
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        return path if _is_private_folder(path) else None
    except (OSError, RuntimeError):  # RuntimeError: nobody knows where the user's home is
        return None


def _is_private_folder(path: Path) -> bool:
    """Return whether a path is a folder, not a link to one, that only this user can write to."""
    status = path.lstat()
    return stat.S_ISDIR(status.st_mode) and is_private(status)


def is_private(status: os.stat_result) -> bool:
    """Whether a file is this user's, and nobody else may write it."""
    return status.st_uid == os.geteuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def load_or_build(key: bytes, build: Callable[[], Any]) -> Any:
    """Return plain data that is kept under a key, built if it is not there, or damaged, or if nothing can be kept.

    Args:
        key: All that the data depends on, and first of all the name and the version of what builds
            it.
        build: Makes it: lists, dictionaries, text and numbers, which come back equal to the last
            bit.
    """
    here = find_cache_folder()
    path = None if here is None else here / f"{hashlib.sha256(key).hexdigest()[:40]}.json"
    if path is not None:
        with contextlib.suppress(OSError, ValueError):  # ValueError: what is there is no record
            return _read_record(path)
    data = build()
    if path is not None:
        text = json.dumps(data)
        with contextlib.suppress(OSError):
            write_private_file(
                path, f"{hashlib.sha256(text.encode()).hexdigest()}\n{text}".encode()
            )
    return data


def write_private_file(path: Path, data: bytes) -> None:
    """Write a file whole or not at all, for the owner's eyes only. Raises OSError if it cannot be written."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=TEMPORARY_PREFIX)
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
        Path(temporary).replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            Path(temporary).unlink()
        raise


def _read_record(path: Path) -> Any:
    """Return what a record says. Raises OSError if it is not there or somebody else's, ValueError if it is damaged."""
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC), "rb") as stream:
        status = os.fstat(stream.fileno())
        if (
            not stat.S_ISREG(status.st_mode)
            or not is_private(status)
            or status.st_size > _MAX_RECORD_SIZE
        ):
            raise PermissionError(f"others may have written {path}")
        digest, _, text = stream.read().partition(b"\n")
    if hashlib.sha256(text).hexdigest().encode() != digest:
        raise ValueError(f"{path} is damaged")
    with contextlib.suppress(OSError):
        os.utime(path)  # when it was used last
    return json.loads(text)
