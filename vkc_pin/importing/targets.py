"""Checks the folder that an import writes to, and formats the comments of its YAML files."""

from __future__ import annotations

from pathlib import Path

from vkc_pin.errors import InputError

__all__ = ["check_target", "format_comment", "get_origin_marker"]

_FIRST = 4096  # characters of a first line: names of files have up to 255 bytes, escaped up to 1530


def get_origin_marker(command: str) -> str:
    """Return what the first line of a YAML file says by which a folder is known to be made by a command, e.g. "import-home"."""
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
    """Check that an import may write a folder, so that nobody loses one of another kind.

    Args:
        folder: The folder.
        command: What imports, e.g. "import-home".
        force: Whether to replace what it made before.

    Raises:
        InputError: Something else is there, or it may not be replaced.
    """
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    own = folder.is_dir() and any(
        get_origin_marker(command) in _first_line(file) for file in folder.glob("*.yaml")
    )
    if force and own:
        return
    expected = "a new or an empty folder" + (
        ", or force=True (--force) to replace it" if own else ""
    )
    got = (
        "a file" if not folder.is_dir() else f"what {command} made before" if own else "other files"
    )
    raise InputError(
        "there is something already", file=folder, field="folder", expected=expected, got=got
    )


def _first_line(file: Path) -> str:
    try:
        with file.open(errors="replace") as stream:
            return stream.readline(_FIRST)
    except OSError:
        return ""
