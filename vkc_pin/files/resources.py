"""Paths of files: of those that users name, and of the robots and scenes that travel with the package."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from typing import Any

import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError, shown

__all__ = ["available", "example_robot_data", "file_path", "find", "folder", "located", "package_folder"]


def package_folder() -> Path:
    """Return the folder of the package's sources."""
    return Path(__file__).resolve().parents[1]


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


def file_path(value: Any, field: str, expected: str = "a path") -> Path:
    """Return the path of a file, whether it exists or not.

    Raises:
        InputError: It is neither text nor a path, or no file can be called that.
    """
    if not isinstance(value, str | Path):
        raise InputError("not a path", field=field, expected=expected, got=shown(value))
    name = str(value)
    try:
        coded = os.fsencode(name)
    except UnicodeEncodeError:
        coded = b""
    if not coded or b"\0" in coded or len(coded) >= 4096 or max(map(len, coded.split(b"/"))) > 255:
        raise InputError("no file can be called that", field=field, expected=expected, got=shown(name))
    return Path(value)


def located(name_or_path: str | Path, kind: str, pattern: str, *, what: str) -> Path:
    """Return a file by its path (of a .yaml file, or with a slash in it), or by its name; see `find`.

    Raises:
        UnknownNameError: There is none of that name.
        InputError: It is neither a name nor a path.
    """
    path = file_path(name_or_path, what, f"the name of a {what}, or a path")
    name = str(name_or_path)
    by_path = isinstance(name_or_path, Path) or name.endswith((".yaml", ".yml")) or "/" in name
    return path if by_path else find(kind, pattern, name, what=what)


def example_robot_data() -> Path | None:
    """Return the folder of example-robot-data (in the wheels of cmeel: cmeel.prefix/share), or None."""
    prefixes = [Path(pin.__file__).resolve().parents[4]]
    spec = importlib.util.find_spec("cmeel")
    if spec is not None and spec.origin is not None:
        prefixes.append(Path(spec.origin).resolve().parents[1] / "cmeel.prefix")
    for prefix in prefixes:
        if (prefix / "share" / "example-robot-data" / "robots").is_dir():
            return prefix / "share" / "example-robot-data"
    return None
