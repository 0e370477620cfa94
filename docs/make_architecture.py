"""Draws docs/images/architecture.svg from the package's imports: `python docs/make_architecture.py`. Needs nothing but Python.

Rows are the layers of the import contract in pyproject.toml. An arrow leads from a wing to one that it imports, unless others
lead there too. What is open to all has no arrows.
"""

from __future__ import annotations

import ast
import textwrap
import tomllib
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "vkc_pin"
FILE = ROOT / "docs" / "images" / "architecture.svg"
OPEN_TO_ALL = {"arrays", "budget", "cache", "compiled", "errors", "kept", "notebook", "options"}
CHECKING = {"validation"}
# Where wings stand, from the left: so that arrows find their way between them. Others share their row.
COLUMNS = {
    **dict.fromkeys(("cli", "benchmarks", "baselines", "planning", "solver", "motion", "scene", "models", "files"), 2),
    **{"seeds": 0, "driving": 0, "program": 1, "chain": 1, "task": 1, "cpin": 1},
    **{"visualization": 3, "validation": 3, "plotting": 4, "options": 3, "distances": 3, "importing": 4},
}
WIDTH, COLUMN, ROW, MARGIN = 1100, 200, 88, 46  # [pixels], as are all lengths here
BOX_WIDTH, BOX_HEIGHT, CHARACTERS = 186, 60, 30
ROOM = 12  # between an arrow and boxes that it passes


def layers() -> list[list[str]]:
    """Return the layers of the import contract, top first, each with its wings."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    (contract,) = (one for one in settings["tool"]["importlinter"]["contracts"] if one["type"] == "layers")
    return [[name.strip() for name in line.split("|")] for line in contract["layers"]]


def imported() -> dict[str, set[str]]:
    """Return wing → wings that it imports, inside functions and for type checkers too."""
    known = {name for layer in layers() for name in layer}
    found: dict[str, set[str]] = {name: set() for name in known}
    for file in PACKAGE.rglob("*.py"):
        wing = file.relative_to(PACKAGE).with_suffix("").parts[0]
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if wing in known and isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "vkc_pin":
                inside = (node.module or "").split(".")[1:2] or [alias.name for alias in node.names]
                found[wing].update(known.intersection(inside) - {wing})
    return found


def arrows() -> list[tuple[str, str]]:
    """Return the imports between wings without those that also lead there through another wing."""
    graph = {wing: others - OPEN_TO_ALL for wing, others in imported().items() if wing not in OPEN_TO_ALL}

    def below(wing: str) -> set[str]:
        return graph[wing].union(*(below(other) for other in graph[wing]))

    return [
        (one, other) for one in sorted(graph) for other in sorted(graph[one]) if not any(other in below(w) for w in graph[one])
    ]


def summary(wing: str) -> list[str]:
    """Return the first sentence of a wing's docstring in two lines, or what of it comes before ";", ":" or ","."""
    file = PACKAGE / wing / "__init__.py"
    text = ast.get_docstring(ast.parse((file if file.is_file() else PACKAGE / f"{wing}.py").read_text(encoding="utf-8"))) or ""
    for end in (". ", "; ", ": ", ", "):
        text = text.splitlines()[0].split(end)[0].rstrip(".")
        lines = textwrap.wrap(text, CHARACTERS)
        if len(lines) <= 2:
            return lines
    raise ValueError(f"the docstring of vkc_pin.{wing} begins with too long a sentence")


def places(rows: list[list[str]]) -> dict[str, tuple[float, float]]:
    """Return the centre of every wing's box."""
    found = {}
    for number, row in enumerate(rows):
        for k, wing in enumerate(row):
            column = COLUMNS.get(wing, 2 + k - (len(row) - 1) / 2)
            found[wing] = WIDTH / 2 + (column - 2) * COLUMN, MARGIN + number * ROW
    return found


def arrow(one: tuple[float, float], other: tuple[float, float], boxes: list[tuple[float, float]]) -> str:
    """Return a line from box to box that passes those between them where there is room."""
    (x0, y0), (x1, y1) = one, other
    between = [x for x, y in boxes if y0 < y < y1]
    free = [x for x in range(WIDTH) if all(abs(x - box) > BOX_WIDTH / 2 + ROOM for box in between)]
    lane = min(free, key=lambda x: (abs(x - x0) + abs(x - x1), abs(x - x1)))
    top, bottom, gap = y0 + BOX_HEIGHT / 2, y1 - BOX_HEIGHT / 2 - 4, ROW - BOX_HEIGHT - 4
    bends = [(x0, lane, top, top + gap), (lane, x1, bottom - gap, bottom)] if between else [(x0, x1, top, bottom)]
    line = f"M{x0:.0f} {top:.0f}"
    for left, right, begin, end in bends:
        line += f" L{left:.0f} {begin:.0f} C{left:.0f} {end:.0f} {right:.0f} {begin:.0f} {right:.0f} {end:.0f}"
    return f'<path d="{line}"/>'


def box(wing: str, x: float, y: float) -> str:
    """Return a box with a wing's name and what it is for."""
    kind = "check" if wing in CHECKING else "open" if wing in OPEN_TO_ALL else "own"
    lines = summary(wing)
    first = y - 14 if len(lines) > 1 else y - 8
    corner = f'x="{x - BOX_WIDTH / 2:.0f}" y="{y - BOX_HEIGHT / 2:.0f}" width="{BOX_WIDTH}" height="{BOX_HEIGHT}"'
    texts = [f'<text x="{x:.0f}" y="{first + 4:.0f}" class="name">{wing}</text>']
    texts += [
        f'<text x="{x:.0f}" y="{first + 20 + 14 * k:.0f}" class="more">{escape(text)}</text>' for k, text in enumerate(lines)
    ]
    return "\n".join([f'<rect {corner} rx="7" class="{kind}"/>', *texts])


def main() -> str:
    """Return the picture."""
    rows = layers()
    centres = places(rows)
    boxes = list(centres.values())
    height = 2 * MARGIN + ROW * (len(rows) - 1)
    style = (
        "text { font-family: system-ui, sans-serif; text-anchor: middle; fill: #1f2933; } .name { font-size: 14px; } "
        ".more { font-size: 11px; fill: #52606d; } .own { fill: #e3edf7; stroke: #4c78a8; } "
        ".check { fill: #fdebd9; stroke: #d9822b; } .open { fill: #ffffff; stroke: #8a94a3; } "
        "path { fill: none; stroke: #7b8794; stroke-width: 1.3; marker-end: url(#tip); }"
    )
    tip = (
        '<marker id="tip" viewBox="0 0 8 8" refX="6" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<polygon points="0,0 8,4 0,8" fill="#7b8794"/></marker>'
    )
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" height="{height}">',
        f'<style>{style}</style><defs>{tip}</defs><rect width="{WIDTH}" height="{height}" rx="10" fill="#fbfcfd"/>',
        *(arrow(centres[one], centres[other], boxes) for one, other in arrows()),
        *(box(wing, *centre) for wing, centre in centres.items()),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


if __name__ == "__main__":
    FILE.write_text(main(), encoding="utf-8")
