"""Draws docs/images/architecture.svg from the package's imports.

Rows are the layers of the import contract in pyproject.toml. An arrow leads from a package to one
that it imports, unless others lead there too. Packages that all others import have no arrows.
"""

from __future__ import annotations

import ast
import textwrap
import tomllib
from html import escape

from docs.pictures import IMAGES, ROOT

PACKAGE = ROOT / "vkc_pin"
FOUNDATION = {"errors", "utils", "options"}  # imported by all others
CHECKS = {"validation"}
COLUMN = {
    "validation": 1,
    "procedural": -1,
    "importing": -1,
    "simulation": 1,
    "datasets": 1,
    "baselines": -1,
}
WIDTH, SPACING, ROW, MARGIN = 860, 250, 88, 46  # [pixels], as are all lengths here
BOX_WIDTH, BOX_HEIGHT, CHARACTERS = 216, 60, 36
GAP = 12  # between an arrow and boxes that it passes


def layers() -> list[list[str]]:
    """Return the layers of the import contract, top first, each with its packages."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = settings["tool"]["importlinter"]["contracts"]
    (contract,) = (
        one for one in contracts if one["type"] == "layers" and one["containers"] == ["vkc_pin"]
    )
    return [[name.strip() for name in line.split("|")] for line in contract["layers"]]


def find_imports() -> dict[str, set[str]]:
    """Return package → packages imported at the top of its modules, not inside functions."""
    known = {name for layer in layers() for name in layer}
    found: dict[str, set[str]] = {name: set() for name in known}
    for file in PACKAGE.rglob("*.py"):
        package = file.relative_to(PACKAGE).with_suffix("").parts[0]
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if (
                package in known
                and isinstance(node, ast.ImportFrom)
                and (node.module or "").split(".")[0] == "vkc_pin"
            ):
                inside = (node.module or "").split(".")[1:2] or [alias.name for alias in node.names]
                found[package].update(known.intersection(inside) - {package})
    return found


def find_arrows() -> list[tuple[str, str]]:
    """Return the imports between packages, without those that follow from others."""
    imports = find_imports().items()
    graph = {
        package: others - FOUNDATION for package, others in imports if package not in FOUNDATION
    }

    def below(package: str) -> set[str]:
        return graph[package].union(*(below(other) for other in graph[package]))

    return [
        (one, other)
        for one in sorted(graph)
        for other in sorted(graph[one])
        if not any(other in below(between) for between in graph[one])
    ]


def summarize(package: str) -> list[str]:
    """Return the first sentence of a package's docstring in two lines, shortened if necessary."""
    file = PACKAGE / package / "__init__.py"
    source = (file if file.is_file() else PACKAGE / f"{package}.py").read_text(encoding="utf-8")
    text = (ast.get_docstring(ast.parse(source)) or "").splitlines()[0]
    for end in (". ", "; ", ": ", ", "):
        text = text.split(end)[0].rstrip(".")
        lines = textwrap.wrap(text, CHARACTERS)
        if len(lines) <= 2:
            return lines
    raise ValueError(f"the docstring of vkc_pin.{package} begins with too long a sentence")


def place_boxes(rows: list[list[str]]) -> dict[str, tuple[float, float]]:
    """Return the centre of each package's box."""
    found = {}
    for number, row in enumerate(rows):
        for k, package in enumerate(row):
            column = COLUMN.get(package, k - (len(row) - 1) / 2)
            found[package] = WIDTH / 2 + column * SPACING, MARGIN + number * ROW
    return found


def draw_arrow(
    one: tuple[float, float], other: tuple[float, float], boxes: list[tuple[float, float]]
) -> str:
    """Return a line from box to box that passes between the boxes of the rows in between."""
    (x0, y0), (x1, y1) = one, other
    between = [x for x, y in boxes if y0 < y < y1]
    free = [x for x in range(WIDTH) if all(abs(x - box) > BOX_WIDTH / 2 + GAP for box in between)]
    lane = min(free, key=lambda x: (abs(x - x0) + abs(x - x1), abs(x - x1)))
    top, bottom, gap = y0 + BOX_HEIGHT / 2, y1 - BOX_HEIGHT / 2 - 4, ROW - BOX_HEIGHT - 4
    bends = (
        [(x0, lane, top, top + gap), (lane, x1, bottom - gap, bottom)]
        if between
        else [(x0, x1, top, bottom)]
    )
    line = f"M{x0:.0f} {top:.0f}"
    for left, right, begin, end in bends:
        line += f" L{left:.0f} {begin:.0f} C{left:.0f} {end:.0f}"
        line += f" {right:.0f} {begin:.0f} {right:.0f} {end:.0f}"
    return f'<path d="{line}"/>'


def draw_box(package: str, x: float, y: float) -> str:
    """Return a box with the name and the summary of a package."""
    kind = "check" if package in CHECKS else "open" if package in FOUNDATION else "own"
    lines = summarize(package)
    first = y - 14 if len(lines) > 1 else y - 8
    corner = (
        f'x="{x - BOX_WIDTH / 2:.0f}" y="{y - BOX_HEIGHT / 2:.0f}" '
        f'width="{BOX_WIDTH}" height="{BOX_HEIGHT}"'
    )
    texts = [f'<text x="{x:.0f}" y="{first + 4:.0f}" class="name">{package}</text>']
    texts += [
        f'<text x="{x:.0f}" y="{first + 20 + 14 * k:.0f}" class="more">{escape(text)}</text>'
        for k, text in enumerate(lines)
    ]
    return "\n".join([f'<rect {corner} rx="7" class="{kind}"/>', *texts])


def make() -> None:
    """Write the picture."""
    (IMAGES / "architecture.svg").write_text(draw(), encoding="utf-8")


def draw() -> str:
    """Return the picture."""
    rows = layers()
    centres = place_boxes(rows)
    boxes = list(centres.values())
    height = 2 * MARGIN + ROW * (len(rows) - 1)
    style = (
        "text { font-family: system-ui, sans-serif; text-anchor: middle; fill: #1f2933; } "
        ".name { font-size: 14px; } "
        ".more { font-size: 11px; fill: #52606d; } .own { fill: #e3edf7; stroke: #4c78a8; } "
        ".check { fill: #fdebd9; stroke: #d9822b; } .open { fill: #ffffff; stroke: #8a94a3; } "
        "path { fill: none; stroke: #7b8794; stroke-width: 1.3; marker-end: url(#tip); }"
    )
    tip = (
        '<marker id="tip" viewBox="0 0 8 8" refX="6" refY="4" '
        'markerWidth="7" markerHeight="7" orient="auto">'
        '<polygon points="0,0 8,4 0,8" fill="#7b8794"/></marker>'
    )
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" '
        f'width="{WIDTH}" height="{height}">',
        f"<style>{style}</style><defs>{tip}</defs>"
        f'<rect width="{WIDTH}" height="{height}" rx="10" fill="#fbfcfd"/>',
        *(draw_arrow(centres[one], centres[other], boxes) for one, other in find_arrows()),
        *(draw_box(package, *centre) for package, centre in centres.items()),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"
