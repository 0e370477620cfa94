"""Checks the folder that an import writes to, and formats the comments of its YAML files."""

from __future__ import annotations

from pathlib import Path

from vkc_pin.errors import InputError

__all__ = ["check_target", "format_comment", "get_origin_marker"]

# Characters to read of a first line: file names have up to 255 bytes, or 1530 when escaped.
_FIRST_LINE_LENGTH = 4096


def get_origin_marker(command: str) -> str:
    """Return the marker in a YAML file's first line that names the command that wrote it."""
    return f"by vkc-pin {command}"


def format_comment(text: str) -> str:
    """Format text as one line of a YAML comment.

    Backslashes and unprintable characters, line breaks among them, become Python's escapes.
    """
    line = "".join(
        letter
        if letter.isprintable() and letter != "\\"
        else letter.encode("unicode_escape").decode("ascii")
        for letter in text
    )
    return f"# {line}\n"


def check_target(folder: Path, command: str, *, force: bool) -> None:
    """Check that an import may write to a folder, so that it does not overwrite other files.

    Args:
        folder: The folder.
        command: Name of the command, e.g. "import-home".
        force: Whether the command may replace its own earlier output.

    Raises:
        InputError: The folder holds other files, or may not be replaced.
    """
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    own = folder.is_dir() and any(
        get_origin_marker(command) in _read_first_line(file) for file in folder.glob("*.yaml")
    )
    if force and own:
        return
    expected = "a new or an empty folder" + (
        ", or force=True (--force) to replace it" if own else ""
    )
    got = (
        "a file"
        if not folder.is_dir()
        else f"an earlier output of {command}"
        if own
        else "other files"
    )
    raise InputError(
        "the target already exists", file=folder, field="folder", expected=expected, got=got
    )


def _read_first_line(file: Path) -> str:
    """Return the first line of a file, or "" if it cannot be read."""
    try:
        with file.open(errors="replace") as stream:
            return stream.readline(_FIRST_LINE_LENGTH)
    except OSError:
        return ""
