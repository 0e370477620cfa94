"""Renders scenes and plans as HTML for notebooks, with a table and a top view."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from html import escape
from typing import Any, cast

import numpy as np

from vkc_pin.utils.notebook import make_card
from vkc_pin.validation.report import CheckedMotion
from vkc_pin.visualization.plots.style import STYLE
from vkc_pin.visualization.plots.top_view import draw_top_view
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

# [inch], longer side of the picture
_SIDE = 4.4
_DPI = 72
# colours of its palette
_COLOURS = 96
# violations and notes shown; the report has all of them
_LISTED = 6
# colours of texts
_GOOD = "#1a7f37"
_BAD = "#c62828"


@make_card.register(Scene)
def scene_html(scene: Scene) -> str:
    """Render a scene as HTML, with an overview and a top view."""
    objects: list[str] = []
    for name, placed in scene.objects.items():
        if placed.object.free:
            kind = "can be carried"
        else:
            kind = ", ".join(placed.object.coordinates.names) or "no joints"
        held = ", held" if name in scene.held else ""
        objects.append(f"{name} ({kind}{held})")
    x_min, x_max, y_min, y_max = scene.arena
    x, y, yaw = scene.start[:3].tolist()
    rows = [
        ("robot", escape(f"{scene.robot.name}, {len(scene.start) - 3} arm joints")),
        ("start", f"x {x:.2f} m, y {y:.2f} m, yaw {yaw:.2f} rad"),
        ("arena", f"{x_max - x_min:.1f} m × {y_max - y_min:.1f} m"),
        ("objects", escape(", ".join(objects) or "none")),
        ("obstacles", str(len(scene.obstacle_names))),
    ]
    text = f"<b>{escape(scene.name)}</b>{_render_table(rows)}"
    return _arrange(text, _render_picture(scene, None, "the scene from above"))


def motion_html(plan: CheckedMotion) -> str:
    """Render a plan as self-contained HTML, with its result and a top view of the motion."""
    metrics = plan.metrics
    if plan.success:
        mark = f'<span style="color: {_GOOD}">success</span>'
    else:
        mark = f'<span style="color: {_BAD}">{escape(f"FAILED, {plan.status}")}</span>'
    head = f"<b>{escape(plan.scene.name)}: {mark}</b>"
    phases = escape(", ".join(phase.name for phase in plan.trajectory.phases))
    rows = [
        ("base", _format_metric(metrics, "base_path_length", "m", 2)),
        ("arm", _format_metric(metrics, "arm_path_length", "rad", 2)),
        ("clearance", _format_metric(metrics, "clearance", "mm", 1, 1e3)),
        ("duration", _format_metric(metrics, "duration", "s", 1)),
        ("planned in", _format_metric(metrics, "planning_time", "s", 2)),
        ("seed", escape(f"{plan.initialization or 'unknown'}, random numbers {plan.seed}")),
    ]
    problems = _render_problems(plan)
    view = _render_picture(plan.scene, plan.trajectory, "the motion from above")
    return _arrange(f"{head}<div>{phases}</div>{_render_table(rows)}{problems}", view)


def _render_problems(plan: CheckedMotion) -> str:
    """Render a list of the first violations and notes; "" without any."""
    found = [str(violation) for violation in plan.report.violations] + list(plan.report.notes)
    if not found:
        return ""
    lines = found[:_LISTED]
    if len(found) > _LISTED:
        lines.append(f"... and {len(found) - _LISTED} more")
    listed = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return f'<ul style="color: {_BAD}; margin: 4px 0">{listed}</ul>'


def _render_table(rows: list[tuple[str, str]]) -> str:
    """Render a table whose values are HTML."""
    cell = "text-align: left; padding: 1px 10px 1px 0; background: none"
    body = ""
    for name, value in rows:
        body += f'<tr><td style="{cell}; white-space: nowrap">{escape(name)}</td>'
        body += f'<td style="{cell}">{value}</td></tr>'
    return f'<table style="border: none; margin: 6px 0">{body}</table>'


def _arrange(text: str, picture: str) -> str:
    """Render a text and a picture side by side."""
    style = "display: flex; flex-wrap: wrap; gap: 16px; align-items: flex-start"
    return f'<div style="{style}"><div style="max-width: 34em">{text}</div>{picture}</div>'


def _render_picture(scene: Scene, trajectory: Trajectory | None, title: str) -> str:
    """Render a top view without pyplot, so that no backend is selected and no figure stays open."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    x_min, x_max, y_min, y_max = scene.arena
    scale = _SIDE / max(x_max - x_min, y_max - y_min)
    width = max(2.6, scale * (x_max - x_min)) + 0.4
    height = max(1.8, scale * (y_max - y_min)) + 0.6
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width, height), dpi=_DPI, layout="constrained")
        canvas = cast(Any, FigureCanvasAgg(figure))  # its methods have no types
        draw_top_view(figure, World(scene), trajectory, columns=2)
        canvas.draw()
    pixels = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    buffer = io.BytesIO()
    pixels.quantize(_COLOURS, dither=Image.Dither.NONE).save(buffer, format="png", optimize=True)
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    return f'<img alt="{escape(title)}" style="max-width: 100%" src="data:image/png;base64,{data}">'


def _format_metric(
    metrics: Mapping[str, float], name: str, unit: str, digits: int, factor: float = 1.0
) -> str:
    """Format a metric in a unit; a dash if it is unknown."""
    value = metrics.get(name)
    if value is None or not np.isfinite(value):
        return "–"
    return f"{factor * value:.{digits}f} {unit}"
