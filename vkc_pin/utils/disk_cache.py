"""Caches records on disk under a digest of their inputs, in a folder private to the user."""

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

CACHE_VARIABLE = "VKC_PIN_CACHE"
"""Environment variable with the folder around the cache; empty or "off": no cache."""
TEMPORARY_PREFIX = ".new-"
"""Start of the names of incomplete files."""
_FOLDER_NAME = "vkc_pin"
_MAX_RECORD_SIZE = 2**24  # [bytes]; records of large robots have 10 kB


def find_cache_folder() -> Path | None:
    """Return this user's cache folder, which is created if necessary.

    It is the folder `vkc_pin` in `CACHE_VARIABLE`, or else in the user's cache folder. Returns None
    if the cache is off, or if other users could write to it.
    """
    named = os.environ.get(CACHE_VARIABLE)
    if os.name != "posix" or (named is not None and named.strip().lower() in ("", "off")):
        return None
    try:
        if named is not None:
            parent = Path(named).expanduser().absolute()
            parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            if not _is_private_folder(parent):
                return None
        else:
            caches = Path(os.environ.get("XDG_CACHE_HOME", ""))
            parent = caches if caches.is_absolute() else Path.home() / ".cache"
        path = parent / _FOLDER_NAME
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        return path if _is_private_folder(path) else None
    except (OSError, RuntimeError):  # RuntimeError: the user has no known home
        return None


def _is_private_folder(path: Path) -> bool:
    status = path.lstat()  # links are not followed
    return stat.S_ISDIR(status.st_mode) and is_private(status)


def is_private(status: os.stat_result) -> bool:
    """Return whether a file belongs to this user, and no other user may write to it."""
    others_may_write = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return status.st_uid == os.geteuid() and not others_may_write


def load_or_build(key: bytes, build: Callable[[], Any]) -> Any:
    """Return the record of a key; it is built if it is missing or damaged, or the cache is off.

    Args:
        key: Everything that the data depend on, including name and version of the builder.
        build: Returns the data: lists, dictionaries, text and numbers. They are restored exactly.
    """
    folder = find_cache_folder()
    if folder is None:
        return build()
    key_digest = hashlib.sha256(key).hexdigest()
    path = folder / f"{key_digest[:40]}.json"
    with contextlib.suppress(OSError, ValueError):
        return _read_record(path)
    data = build()
    text = json.dumps(data)
    text_digest = hashlib.sha256(text.encode()).hexdigest()
    with contextlib.suppress(OSError):
        write_private_file(path, f"{text_digest}\n{text}".encode())
    return data


def write_private_file(path: Path, data: bytes) -> None:
    """Write a file atomically, readable by its owner only. Raises OSError on failure."""
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
    """Return a record. Raises OSError if it is missing or foreign, ValueError if it is damaged."""
    handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    with os.fdopen(handle, "rb") as stream:
        status = os.fstat(stream.fileno())
        is_own_file = stat.S_ISREG(status.st_mode) and is_private(status)
        if not is_own_file or status.st_size > _MAX_RECORD_SIZE:
            raise PermissionError(f"others may have written {path}")
        digest, _, text = stream.read().partition(b"\n")
    if hashlib.sha256(text).hexdigest().encode() != digest:
        raise ValueError(f"{path} is damaged")
    with contextlib.suppress(OSError):
        os.utime(path)  # time of the last use
    return json.loads(text)
