"""Parses XML with the line of every element, and quotes text for XML."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from vkc_pin.errors import InputError, format_value
from vkc_pin.world.files.documents import read_text

__all__ = [
    "check_collada",
    "find_line",
    "make_element_error",
    "parse_xml",
    "quote",
    "read_xml",
    "replace_forbidden",
]

_INDEX_ELEMENTS = ("h", "p", "v", "vcount")
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


def parse_xml(text: str, file: Path) -> ElementTree.Element:
    """Return the root of an XML document; `file` is for messages."""
    builder = ElementTree.TreeBuilder(element_factory=_Element)
    parser, depth = expat.ParserCreate(), 0

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

    def entity(name: str, *_: object) -> None:
        raise InputError(
            "entities are not supported",
            file=file,
            line=parser.CurrentLineNumber,
            field=name,
            expected="plain text",
        )

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler, parser.EntityDeclHandler = builder.data, entity
    try:
        parser.Parse(text.encode(), True)
        return builder.close()
    except expat.ExpatError as error:
        raise InputError(f"not valid XML: {error}", file=file, line=error.lineno) from error


def replace_forbidden(text: str) -> str:
    """Replace characters that XML 1.0 forbids by U+FFFD."""
    return _FORBIDDEN.sub("\ufffd", text)


def quote(text: str) -> str:
    """Quote text as the value of an XML attribute, without forbidden characters."""
    return quoteattr(replace_forbidden(text))


def check_collada(file: Path) -> float:
    """Check that index lists in a COLLADA file hold integers, and return the file's unit [m].

    Assimp hangs on other index lists, and coal ignores the unit.
    """
    parser, inside = expat.ParserCreate(), list[str]()
    unit = ["1"]

    def start(tag: str, attributes: dict[str, str]) -> None:
        inside.append(tag.rpartition(":")[2])
        if inside == ["COLLADA", "asset", "unit"]:
            unit[:] = [attributes.get("meter", "1")]

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
    try:
        metres = float(unit[0])
    except ValueError:
        metres = math.nan
    if not 0.0 < metres < math.inf:
        field, expected = "<unit> meter", "a positive number"
        raise InputError("not a unit", file=file, field=field, expected=expected, got=unit[0])
    return metres
