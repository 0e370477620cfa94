"""Tests XML against the standard library, and the lines of elements."""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from helpers.expected_errors import expect_error
from hypothesis import given
from hypothesis import strategies as st

from vkc_pin.world.files.xml import find_line, parse_xml, quote, replace_forbidden

FILE = Path("thing.urdf")


@given(
    st.recursive(
        st.text("ab <>&\n", max_size=5), lambda inside: st.lists(inside, max_size=4), max_leaves=20
    )
)
def test_elements_match_the_standard_library_and_have_line_numbers(tree: object) -> None:
    lines = ["<robot>"]

    def append_lines(node: object) -> None:
        if isinstance(node, str):
            escaped = node.replace("&", "&amp;").replace("<", "&lt;").replace("\n", "&#10;")
            lines.append(f'<text value="{escaped}">{escaped}</text>')
        elif isinstance(node, list):
            lines.append(f'<list number="{len(lines) + 1}">')
            for item in node:
                append_lines(item)
            lines.append("</list>")

    append_lines(tree)
    text = "\n".join([*lines, "</robot>"])
    own, theirs = parse_xml(text, FILE), ElementTree.fromstring(text)
    assert ElementTree.tostring(own) == ElementTree.tostring(theirs)
    assert find_line(own) == 1
    for element in own.iter("list"):
        assert find_line(element) == int(element.get("number", ""))
    assert find_line(theirs) is None


@pytest.mark.parametrize(
    ("text", "line"),
    [("<robot>\n<a>\n</robot>", 3), ("", 1), ("<robot/>\n<robot/>", 2), ("<robot", 1)],
)
def test_invalid_xml_raises(text: str, line: int) -> None:
    with expect_error("not valid XML", file=FILE, line=line):
        parse_xml(text, FILE)


def test_entities_are_rejected() -> None:
    """A few lines of entities expand exponentially."""
    many = "".join(f'<!ENTITY e{k} "{f"&e{k - 1};" * 10 if k else "lol"}">' for k in range(12))
    with expect_error("e0: entities are not supported", line=2):
        parse_xml(f'<?xml version="1.0"?>\n<!DOCTYPE r [{many}]><robot name="&e11;"/>', FILE)


@given(st.text())
def test_quoted_text_round_trips(text: str) -> None:
    root = parse_xml(f"<robot name={quote(text)}/>", FILE)
    assert root.get("name") == replace_forbidden(text)


def test_forbidden_characters_become_replacement_characters() -> None:
    text = "a\0b\x1fc\ud800d\uffffe\tf\ng"
    assert replace_forbidden(text) == "a\ufffdb\ufffdc\ufffdd\ufffde\tf\ng"


@pytest.mark.parametrize("depth", [199, 200, 100_000])
def test_deeply_nested_elements_are_rejected(depth: int) -> None:
    text = f"<robot>{'<a>' * depth}{'</a>' * depth}</robot>"
    if depth < 200:
        copied = copy.deepcopy(parse_xml(text, FILE))
        assert ElementTree.tostring(copied) == ElementTree.tostring(parse_xml(text, FILE))
        return
    with expect_error(r"thing\.urdf:1: a: too many elements inside each other"):
        parse_xml(text, FILE)
