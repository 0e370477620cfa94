"""Draws formulas as SVG pictures when the site is built: pages need no script and no font."""

from __future__ import annotations

import html
import re
from functools import cache
from typing import Any

import ziamath
from docutils import nodes
from sphinx.application import Sphinx

SIZE = 16.0  # of the font a formula is drawn with [pixels]
SCALE = (
    1.08 / SIZE
)  # to the font around it [em]: its small letters are then as high as those of the text


@cache
def draw_formula(latex: str, inline: bool) -> str:
    """Return the SVG picture of a formula, scaled to the text and aligned with its baseline."""
    picture = str(ziamath.Latex(latex, size=SIZE, inline=inline, color="currentColor").svg())
    found = re.search(r'viewBox="([-\d.]+) ([-\d.]+) ([-\d.]+) ([-\d.]+)"', picture)
    if found is None:
        raise RuntimeError(f"found no picture of {latex}")
    _, top, width, height = map(float, found.groups())
    if inline:
        size = f"width:{width * SCALE:.3f}em;height:{height * SCALE:.3f}em"
        style = f"{size};vertical-align:{-(top + height) * SCALE:.3f}em"
    else:  # site.css lets it shrink on telephones
        style = f"--width:{width * SCALE:.3f}em"
    label = html.escape(latex.strip(), quote=True)
    about = f'class="formula" role="img" aria-label="{label}" style="{style}"'
    return picture.replace("<svg ", f"<svg {about} ", 1)


def inline_formula(self: Any, node: nodes.math) -> None:
    """Write a formula within a line."""
    self.body.append(draw_formula(node.astext(), True))
    raise nodes.SkipNode


def displayed_formula(self: Any, node: nodes.math_block) -> None:
    """Write a formula that stands alone."""
    self.body.append(f'<div class="formula">{draw_formula(node.astext(), False)}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, Any]:
    """Tell Sphinx about the renderer `svg`."""
    ziamath.config.svg2 = (
        False  # every picture brings its own glyphs: those of several would have the same names
    )
    app.add_html_math_renderer("svg", (inline_formula, None), (displayed_formula, None))
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
