"""Parses tables in Markdown."""

from __future__ import annotations


def parse_cells(text: str) -> list[list[str]]:
    """Return the rows of a Markdown table, without the separator."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()]
    assert all(set(cell) <= set("-:") for cell in rows[1])
    assert len({len(row) for row in rows}) == 1
    return [rows[0], *rows[2:]]
