"""Draws docs/images/data_flow.svg: the modules in the order in which data flows. Needs nothing but Python."""

from __future__ import annotations

from html import escape
from pathlib import Path

WIDTH, HEIGHT, ROW = 960, 640, 78
# name: (text, second line, column's centre, row, kind)
BOXES = {
    "files": ("URDF, SRDF, YAML, meshes", "", 300, 0, "given"),
    "steps_in": ("steps, options", "", 735, 0, "given"),
    "robot": ("robot", "urdf · srdf · meshes", 190, 1, "own"),
    "articulation": ("articulation", "documents · object_file", 410, 1, "own"),
    "scene": ("scene", "what stands where", 300, 2, "own"),
    "goal": ("goal · task", "phases", 735, 2, "own"),
    "cpin": ("cpin", "Pinocchio in CasADi", 120, 3, "own"),
    "chain": ("chain", "one model of all", 340, 3, "own"),
    "base": ("base_*", "A* on the floor", 560, 3, "own"),
    "problem": ("problem · transcription", "contact · waypoint · pose", 230, 4, "own"),
    "seeds": ("initialization", "beam · knots · routes · trees", 560, 4, "own"),
    "solver": ("solver · trust_region", "Ipopt between witness planes", 395, 5, "own"),
    "planner": ("planner · chore", "one_problem · all_at_once", 395, 6, "own"),
    "world": ("world", "plain trees, side by side", 850, 4, "check"),
    "validation": ("validation", "knows no chain, no program", 850, 6, "check"),
    "plan": ("plan", "report, motion", 395, 7, "own"),
    "pictures": ("visualization · plotting", "cli · benchmarks", 735, 7, "own"),
}
ARROWS = [
    ("files", "robot"), ("files", "articulation"), ("robot", "scene"), ("articulation", "scene"), ("steps_in", "goal"),
    ("scene", "chain"), ("scene", "goal"), ("cpin", "problem"), ("chain", "problem"), ("scene", "base"), ("base", "seeds"),
    ("problem", "solver"), ("problem", "seeds"), ("seeds", "solver"), ("solver", "planner"),
    ("world", "validation"), ("planner", "validation"), ("validation", "planner"), ("planner", "plan"), ("plan", "pictures"),
]  # fmt: skip
BENT = [
    "M360 219 C360 235 372 235 388 235 H836 Q850 235 850 249 V325",
    "M735 219 V301 Q735 312 724 312 H291 Q280 312 280 320 V325",
]  # scene to world, goal to problem
LOOKS = {"given": ("#ffffff", "#8a94a3"), "own": ("#e3edf7", "#4c78a8"), "check": ("#fdebd9", "#d9822b")}
BOX_WIDTH, BOX_HEIGHT = 200, 46


def centre(name: str) -> tuple[float, float]:
    """Return where a box's centre is [pixels]."""
    return BOXES[name][2], 40 + ROW * BOXES[name][3]


def arrow(one: str, other: str) -> str:
    """Return a line from box to box; two boxes that send to each other get one line each."""
    (x0, y0), (x1, y1) = centre(one), centre(other)
    if y0 == y1:
        shift = 0 if (other, one) not in ARROWS else (-8 if x1 > x0 else 8)
        side = 1 if x1 > x0 else -1
        x0, x1, y0, y1 = x0 + side * BOX_WIDTH / 2, x1 - side * (BOX_WIDTH / 2 + 4), y0 + shift, y1 + shift
        return f'<path d="M{x0:g} {y0:g} L{x1:g} {y1:g}"/>'
    y0, y1 = y0 + BOX_HEIGHT / 2, y1 - BOX_HEIGHT / 2 - 4
    middle = y1 - 14
    return f'<path d="M{x0:g} {y0:g} C{x0:g} {middle:g} {x1:g} {y0 + 14:g} {x1:g} {y1:g}"/>'


def box(name: str) -> str:
    """Return a box with its text."""
    text, below, _, _, kind = BOXES[name]
    (x, y), (fill, edge) = centre(name), LOOKS[kind]
    left, top = x - BOX_WIDTH / 2, y - BOX_HEIGHT / 2
    size = f'x="{left:g}" y="{top:g}" width="{BOX_WIDTH}" height="{BOX_HEIGHT}"'
    lines = [f'<rect {size} rx="7" fill="{fill}" stroke="{edge}"/>']
    lines.append(f'<text x="{x:g}" y="{y + (-3 if below else 5):g}" class="name">{escape(text)}</text>')
    if below:
        lines.append(f'<text x="{x:g}" y="{y + 14:g}" class="more">{escape(below)}</text>')
    return "\n".join(lines)


def main() -> None:
    """Write the picture."""
    style = "text { font-family: system-ui, sans-serif; text-anchor: middle; fill: #1f2933; } "
    style += ".name { font-size: 14px; } .more { font-size: 11.5px; fill: #52606d; } "
    style += "path { fill: none; stroke: #7b8794; stroke-width: 1.3; marker-end: url(#tip); }"
    tip = '<marker id="tip" viewBox="0 0 8 8" refX="6" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
    tip += '<polygon points="0,0 8,4 0,8" fill="#7b8794"/></marker>'
    labels = [(622, 40 + ROW * 6 - 14, "motion"), (622, 40 + ROW * 6 + 24, "report")]
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}">',
        f'<style>{style}</style><defs>{tip}</defs><rect width="{WIDTH}" height="{HEIGHT}" rx="10" fill="#fbfcfd"/>',
        *(arrow(*ends) for ends in ARROWS),
        *(f'<path d="{line}"/>' for line in BENT),
        *(box(name) for name in BOXES),
        *(f'<text x="{x}" y="{y}" class="more">{text}</text>' for x, y, text in labels),
        "</svg>",
    ]
    file = Path(__file__).parent / "images" / "data_flow.svg"
    file.write_text("\n".join(parts) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
