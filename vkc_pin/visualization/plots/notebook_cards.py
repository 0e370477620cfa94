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

_SIDE = 4.4  # [inch], longer side of the picture
_DPI = 72
_COLOURS = 96  # of its palette
_LISTED = 6  # violations and notes shown; the report has all of them
_GOOD, _BAD = "#1a7f37", "#c62828"


@make_card.register(Scene)
def scene_html(scene: Scene) -> str:
    """Render a scene as HTML, with an overview and a top view."""
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
    return _arrange(
        f"<b>{escape(scene.name)}</b>{_render_table(rows)}",
        _render_picture(scene, None, "the scene from above"),
    )


def motion_html(plan: CheckedMotion) -> str:
    """Render a plan as self-contained HTML, with its result and a top view of the motion."""
    m = plan.metrics
    good = plan.success
    status = "success" if good else f"FAILED, {plan.status}"
    mark = f'<span style="color: {_GOOD if good else _BAD}">{escape(status)}</span>'
    head = f"<b>{escape(plan.scene.name)}: {mark}</b>"
    phases = escape(", ".join(phase.name for phase in plan.trajectory.phases))
    rows = [
        ("base", _format_metric(m, "base_path_length", "m", 2)),
        ("arm", _format_metric(m, "arm_path_length", "rad", 2)),
        ("clearance", _format_metric(m, "clearance", "mm", 1, 1e3)),
        ("duration", _format_metric(m, "duration", "s", 1)),
        ("planned in", _format_metric(m, "planning_time", "s", 2)),
        ("seed", escape(f"{plan.initialization or 'unknown'}, random numbers {plan.seed}")),
    ]
    found = [str(violation) for violation in plan.report.violations] + list(plan.report.notes)
    lines = [
        *found[:_LISTED],
        *([f"... and {len(found) - _LISTED} more"] if len(found) > _LISTED else []),
    ]
    listed = "".join(f"<li>{escape(line)}</li>" for line in lines)
    problems = f'<ul style="color: {_BAD}; margin: 4px 0">{listed}</ul>' if lines else ""
    view = _render_picture(plan.scene, plan.trajectory, "the motion from above")
    return _arrange(f"{head}<div>{phases}</div>{_render_table(rows)}{problems}", view)


def _render_table(rows: list[tuple[str, str]]) -> str:
    """Render a table whose values are HTML."""
    cell = "text-align: left; padding: 1px 10px 1px 0; background: none"
    body = "".join(
        f'<tr><td style="{cell}; white-space: nowrap">{escape(name)}</td>'
        f'<td style="{cell}">{value}</td></tr>'
        for name, value in rows
    )
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
    wide, high = x_max - x_min, y_max - y_min
    scale = _SIDE / max(wide, high)
    with matplotlib.rc_context(STYLE):
        figure = Figure(
            figsize=(max(2.6, scale * wide) + 0.4, max(1.8, scale * high) + 0.6),
            dpi=_DPI,
            layout="constrained",
        )
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
    value = metrics.get(name)
    return (
        f"{factor * value:.{digits}f} {unit}" if value is not None and np.isfinite(value) else "–"
    )
