"""Finds the robots and scenes that travel with the package, installed or in a source tree."""

from __future__ import annotations

from pathlib import Path

from vkc_pin.errors import UnknownNameError

__all__ = ["available", "find", "folder", "package_folder"]


def package_folder() -> Path:
    """Return the folder of the package's sources."""
    return Path(__file__).resolve().parent


def folder(kind: str) -> Path:
    """Return the folder of `kind` ("robots" or "scenes"): inside the installed package, else beside it."""
    package = package_folder()
    inside = package / kind
    return inside if inside.is_dir() else package.parent / kind


def available(kind: str, pattern: str) -> dict[str, Path]:
    """Return name → path of what `folder(kind)` holds, by glob `pattern` (the name is the file's or folder's stem)."""
    return {path.stem: path for path in sorted(folder(kind).glob(pattern))}


def find(kind: str, pattern: str, name: str, *, what: str) -> Path:
    """Return the path of `name` among `available(kind, pattern)`.

    Raises:
        UnknownNameError: There is none; `what` ("robot", "scene") names the kind in the message.
    """
    found = available(kind, pattern)
    if name not in found:
        raise UnknownNameError(what, name, found)
    return found[name]
