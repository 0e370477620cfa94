"""Reads XML with the line of every element, and quotes text for XML."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from vkc_pin.errors import InputError, format_value
from vkc_pin.world.files.documents import read_text

__all__ = [
    "check_indices",
    "find_line",
    "parse_xml",
    "quote",
    "read_xml",
    "replace_forbidden",
]

_INDEX_ELEMENTS = ("h", "p", "v", "vcount")
_FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


class _Element(ElementTree.Element):
    """An element that knows where it begins."""

    line: int | None = None


def find_line(element: ElementTree.Element) -> int | None:
    """Return the line in which an element begins, counted from 1; None if that is not known."""
    return getattr(element, "line", None)


def read_xml(
    file: str | Path, kind: str, text: str | None = None
) -> tuple[str, ElementTree.Element]:
    """Return what a URDF or SRDF file (`kind`) says, as text and as its element <robot>.

    Args:
        file: The file.
        kind: "URDF" or "SRDF".
        text: What it says, where that stands elsewhere: nothing is read then, and `file` is for
            messages alone.

    Raises:
        InputError: It cannot be read, is no XML, or is about something else than a robot.
    """
    text = read_text(file, kind) if text is None else text
    root = parse_xml(text, Path(file))
    if root.tag != "robot":
        raise InputError(
            f"this is no {kind}", file=file, expected="an element <robot>", got=f"<{root.tag}>"
        )
    return text, root


def parse_xml(text: str, file: Path) -> ElementTree.Element:
    """Return the root of an XML document.

    Args:
        text: What it says.
        file: Where it stands, for messages.

    Raises:
        InputError: It is no XML, or defines entities: with a few lines these make texts without
            end.
    """
    builder = ElementTree.TreeBuilder(element_factory=_Element)
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        element: Any = builder.start(tag, attributes)
        element.line = parser.CurrentLineNumber

    def entity(name: str, *_: object) -> None:
        raise InputError(
            "entities are not supported",
            file=file,
            line=parser.CurrentLineNumber,
            field=name,
            expected="plain text",
        )

    parser.StartElementHandler, parser.EndElementHandler = start, builder.end
    parser.CharacterDataHandler, parser.EntityDeclHandler = builder.data, entity
    try:
        parser.Parse(text.encode(), True)
        return builder.close()
    except expat.ExpatError as error:
        raise InputError(f"not valid XML: {error}", file=file, line=error.lineno) from error


def replace_forbidden(text: str) -> str:
    """Replace characters that XML 1.0 forbids, such as most control characters, by U+FFFD."""
    return _FORBIDDEN.sub("\ufffd", text)


def quote(text: str) -> str:
    """Quote text as the value of an XML attribute, without forbidden characters."""
    return quoteattr(replace_forbidden(text))


def check_indices(file: Path) -> None:
    """Check that the lists of indices in a COLLADA file hold whole numbers.

    assimp, which reads these files, does not get past anything else in them, and takes ever more
    memory meanwhile.

    Raises:
        InputError: One holds something else, the file is no XML, or it cannot be read.
    """
    parser, inside = expat.ParserCreate(), list[str]()

    def start(tag: str, _: dict[str, str]) -> None:
        inside.append(tag.rpartition(":")[2])

    def text(data: str) -> None:
        if inside and inside[-1] in _INDEX_ELEMENTS and data.strip("0123456789+- \t\r\n"):
            line, field = parser.CurrentLineNumber, f"<{inside[-1]}>"
            raise InputError(
                "not indices",
                file=file,
                line=line,
                field=field,
                expected="whole numbers",
                got=format_value(data),
            )

    def end(_: str) -> None:
        inside.pop()

    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = (
        start,
        end,
        text,
    )
    try:
        parser.Parse(file.read_bytes(), True)
    except expat.ExpatError as error:
        raise InputError(f"not valid XML: {error}", file=file, line=error.lineno) from error
    except OSError as error:
        raise InputError("cannot read the file", file=file, got=error.strerror) from error
