"""Checks the folder that an import writes to, and formats the contents of its files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.world.files.writing import MANIFEST, check_writable

# Characters to read of a first line: file names have up to 255 bytes, or 1530 when escaped.
_FIRST_LINE_LENGTH = 4096


def get_origin_marker(command: str) -> str:
    """Return the marker in a YAML file's first line that names the command that wrote it."""
    return f"by vkc-pin {command}"


def format_comment(text: str) -> str:
    """Format text as one line of a YAML comment.

    Backslashes and unprintable characters, line breaks among them, become Python's escapes.
    """
    line = ""
    for letter in text:
        if letter.isprintable() and letter != "\\":
            line += letter
        else:
            line += letter.encode("unicode_escape").decode("ascii")
    return f"# {line}\n"


def round_values(values: Any, digits: int = 6) -> list[float]:
    """Return rounded values without negative zeros."""
    rounded = np.round(np.asarray(values, float), digits)
    # -0.0 + 0.0 is 0.0.
    return [float(value) for value in rounded + 0.0]


def check_source(file: Path, expected: str) -> None:
    """Check that the file to import is no folder, whose name would be that of the target, too.

    Raises:
        InputError: It is a folder.
    """
    if os.path.isdir(file):  # noqa: PTH112 - False also without permission to look
        problem = "cannot import a folder"
        raise InputError(problem, file=file, field="file", expected=expected, got="a folder")


def check_target(folder: Path, command: str, *, force: bool) -> None:
    """Check that an import may write to a folder, so that it does not overwrite other files.

    Args:
        folder: The folder.
        command: Name of the command, e.g. "import-home".
        force: Whether the command may replace its own earlier output.
    """
    is_folder = os.path.isdir(folder)  # noqa: PTH112 - False also without permission to look
    is_own = is_folder and _is_output(folder, command)
    is_free = not os.path.exists(folder) or (is_folder and not any(folder.iterdir()))  # noqa: PTH110
    if is_free or (force and is_own):
        # Before the work, not after it.
        check_writable(folder / MANIFEST, field="folder")
        return
    expected = "a new or an empty folder"
    got = "other files" if is_folder else "a file"
    if is_own:
        expected += ", or force=True (--force) to replace it"
        got = f"an earlier output of {command}"
    raise InputError(
        "the target already exists", file=folder, field="folder", expected=expected, got=got
    )


def _is_output(folder: Path, command: str) -> bool:
    """Return whether a file of the folder says that the command wrote it."""
    marker = get_origin_marker(command)
    return any(marker in _read_first_line(file) for file in folder.glob("*.yaml"))


def _read_first_line(file: Path) -> str:
    """Return the first line of a file, or "" if it cannot be read."""
    try:
        with file.open(errors="replace") as stream:
            return stream.readline(_FIRST_LINE_LENGTH)
    except OSError:
        return ""
