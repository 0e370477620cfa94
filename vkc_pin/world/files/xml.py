"""Parses XML with the line of every element, and quotes text for XML."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any
from xml.parsers import expat

from vkc_pin.errors import InputError
from vkc_pin.world.files.documents import read_text

_MAX_DEPTH = 200  # of elements inside each other: Python writes and copies them recursively
_FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


class _Element(ElementTree.Element):
    """An element with its line."""

    line: int | None = None


def find_line(element: ElementTree.Element) -> int | None:
    """Return the line of an element, counted from 1, or None if it is unknown."""
    return getattr(element, "line", None)


def make_element_error(
    file: str | Path, element: ElementTree.Element, problem: str, **details: object
) -> InputError:
    """Return an error with the line of an element."""
    return InputError(problem, file=file, line=find_line(element), **details)  # type: ignore[arg-type]


def read_xml(
    file: str | Path, kind: str, text: str | None = None
) -> tuple[str, ElementTree.Element]:
    """Return text and root element <robot> of a URDF or SRDF file (`kind`).

    Args:
        file: The file.
        kind: "URDF" or "SRDF".
        text: Contents, if they are not to be read from `file`.
    """
    text = read_text(file, kind) if text is None else text
    root = parse_xml(text, Path(file))
    if root.tag != "robot":
        raise InputError(
            f"this is no {kind}", file=file, expected="an element <robot>", got=f"<{root.tag}>"
        )
    return text, root


def parse_xml(text: str | bytes, file: Path) -> ElementTree.Element:
    """Return the root of an XML document; `file` is for messages.

    Bytes are in the encoding that the document states.
    """
    builder = ElementTree.TreeBuilder(element_factory=_Element)
    parser = expat.ParserCreate()
    depth = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > _MAX_DEPTH:
            raise InputError(
                "too many elements inside each other",
                file=file,
                line=parser.CurrentLineNumber,
                field=tag,
                expected=f"at most {_MAX_DEPTH}",
            )
        element: Any = builder.start(tag, attributes)
        element.line = parser.CurrentLineNumber

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    def refuse_entity(name: str, *_: object) -> None:
        raise InputError(
            "entities are not supported",
            file=file,
            line=parser.CurrentLineNumber,
            field=name,
            expected="plain text",
        )

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = builder.data
    parser.EntityDeclHandler = refuse_entity
    parser.buffer_text = True
    try:
        parser.Parse(text.encode() if isinstance(text, str) else text, True)
        return builder.close()
    except expat.ExpatError as error:
        raise InputError(f"not valid XML: {error}", file=file, line=error.lineno) from error


def replace_forbidden(text: str) -> str:
    """Replace characters that XML 1.0 forbids by U+FFFD."""
    return _FORBIDDEN.sub("\ufffd", text)


def quote(text: str) -> str:
    """Quote text as the value of an XML attribute, without forbidden characters."""
    from xml.sax.saxutils import quoteattr  # imports urllib and http

    return quoteattr(replace_forbidden(text))
