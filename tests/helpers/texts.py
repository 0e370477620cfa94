"""Edits robot descriptions and other text files."""

from __future__ import annotations

from pathlib import Path


def replace_in_file(file: Path, *changes: tuple[str, str], count: int = -1) -> Path:
    """Replace text that a file must contain, in turn, and return the file.

    Args:
        file: The file.
        changes: Old and new text of each replacement.
        count: Largest number of occurrences that a replacement changes. Default: all.
    """
    text = file.read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, count)
    file.write_text(text, encoding="utf-8")
    return file


def format_box(size: str, at: str = "0 0 0", kind: str = "collision", name: str = "") -> str:
    """Return a box of a URDF link."""
    label = f' name="{name}"' if name else ""
    geometry = f'<geometry><box size="{size}"/></geometry>'
    return f'<{kind}{label}><origin xyz="{at}"/>{geometry}</{kind}>'


def format_fixed_link(
    name: str, parent: str, at: str = "0 0 0", shapes: str = "", *, rpy: str = "0 0 0"
) -> str:
    """Return a link and the joint that fixes it to its parent."""
    ends = f'<parent link="{parent}"/><child link="{name}"/><origin xyz="{at}" rpy="{rpy}"/>'
    joint = f'<joint name="{name}_joint" type="fixed">{ends}</joint>'
    return f'<link name="{name}">{shapes}</link>{joint}'
