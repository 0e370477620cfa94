"""What a notebook shows of a scene that is a cell's value: a headline, a small table, and a picture from above."""

from __future__ import annotations

import base64
import io
from html import escape
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from vkc_pin.top_view import STYLE, draw_top_view
from vkc_pin.world import World

if TYPE_CHECKING:
    from vkc_pin.scene import Scene
    from vkc_pin.trajectory import Trajectory

__all__ = ["card", "picture", "scene_html", "table"]

_SIDE, _DPI, _COLOURS = 4.4, 72, 96  # [inch] of the picture's longer side, its resolution, and its colours


def scene_html(scene: Scene) -> str:
    """Return a scene's overview as HTML: what there is in it, and a picture from above."""
    objects = []
    for name, placed in scene.objects.items():
        joints = ", ".join(placed.object.coordinates.names)
        kind = "can be carried" if placed.object.free else joints
        objects.append(f"{name} ({kind or 'no joints'}{', held' if name in scene.held else ''})")
    x_min, x_max, y_min, y_max = scene.arena
    x, y, yaw = scene.start[:3].tolist()
    rows = [
        ("robot", escape(f"{scene.robot.name}, {len(scene.start) - 3} arm joints")),
        ("start", f"x {x:.2f} m, y {y:.2f} m, yaw {yaw:.2f} rad"),
        ("arena", f"{x_max - x_min:.1f} m × {y_max - y_min:.1f} m"),
        ("objects", escape(", ".join(objects) or "none")),
        ("obstacles", str(len(scene.obstacle_names))),
    ]
    return card(f"<b>{escape(scene.name)}</b>{table(rows)}", picture(scene, None, "the scene from above"))


def table(rows: list[tuple[str, str]]) -> str:
    """Return a table; the values are HTML."""
    cell = "text-align: left; padding: 1px 10px 1px 0; background: none"
    body = "".join(
        f'<tr><td style="{cell}; white-space: nowrap">{escape(name)}</td><td style="{cell}">{value}</td></tr>'
        for name, value in rows
    )
    return f'<table style="border: none; margin: 6px 0">{body}</table>'


def card(text: str, picture: str) -> str:
    """Return HTML of a text and, beside it where there is room, a picture."""
    style = "display: flex; flex-wrap: wrap; gap: 16px; align-items: flex-start"
    return f'<div style="{style}"><div style="max-width: 34em">{text}</div>{picture}</div>'


def picture(scene: Scene, trajectory: Trajectory | None, title: str) -> str:
    """Return a picture from above; made without pyplot, so that nothing is kept open and no backend is chosen."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    x_min, x_max, y_min, y_max = scene.arena
    wide, high = x_max - x_min, y_max - y_min
    scale = _SIDE / max(wide, high)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(max(2.6, scale * wide) + 0.4, max(1.8, scale * high) + 0.6), dpi=_DPI, layout="constrained")
        canvas = cast(Any, FigureCanvasAgg(figure))  # its methods have no types
        draw_top_view(figure, World(scene), trajectory, columns=2)
        canvas.draw()
    pixels = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    buffer = io.BytesIO()
    pixels.quantize(_COLOURS, dither=Image.Dither.NONE).save(buffer, format="png", optimize=True)
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    return f'<img alt="{escape(title)}" style="max-width: 100%" src="data:image/png;base64,{data}">'
