"""Plots joints and clearance over time, and the top view of a motion, with matplotlib.

Figures are made without pyplot: they need no screen, and none stays open.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.validation.report import CheckedMotion
from vkc_pin.visualization.plots.clearance import compute_clearance_curves
from vkc_pin.visualization.plots.joints import (
    DASHES,
    SAMPLES,
    draw_joints,
    find_groups,
    name_phases,
)
from vkc_pin.visualization.plots.style import (
    COLOURS,
    new_figure,
    save_figure,
    shade_phases,
    use_style,
)
from vkc_pin.visualization.plots.top_view import draw_top_view
from vkc_pin.world.files.resources import check_path
from vkc_pin.world.files.writing import check_writable
from vkc_pin.world.trajectory.world_model import World

if TYPE_CHECKING:
    from matplotlib.figure import Figure, FigureBase

__all__ = ["PICTURES", "plot", "plot_clearance", "plot_joints", "plot_top_view"]

PICTURES = (".png", ".svg", ".pdf")
"""File name extensions of pictures."""
_SHOWN = 0.30  # larger clearances are cut off [m]


def plot(plan: CheckedMotion, path: str | Path | None = None) -> Figure | dict[str, Figure]:
    """Draw joint positions, velocities and accelerations, clearance, and a top view.

    Args:
        plan: Plan to draw.
        path: Folder (created if necessary) for `joints.png`, `clearance.png` and `top_view.png`;
            or a file ending with .png, .svg or .pdf for one figure with all plots. Default: no
            file. Files are written atomically.

    Returns:
        The figures by name if `path` is a folder, otherwise the figure.

    Raises:
        InputError: `plan` is not a plan, or `path` is a file of another type.
    """
    _check_plan(plan)
    target = None if path is None else check_path(path, "path")
    if target is None or target.suffix.lower() in PICTURES:
        if target is not None:
            check_writable(target)  # before drawing, which takes seconds
        return save_figure(_plot_all(plan), target)
    if target.is_file():
        expected = f"a folder, or a name ending with {', '.join(PICTURES)}"
        raise InputError("path is a file", field="path", file=target, expected=expected)
    figures = {
        "joints": plot_joints(plan),
        "clearance": plot_clearance(plan),
        "top_view": plot_top_view(plan),
    }
    for name, figure in figures.items():
        save_figure(figure, target / f"{name}.png")
    return figures


def plot_joints(plan: CheckedMotion) -> Figure:
    """Plot positions, velocities and accelerations over time with their limits; see `joints`."""
    _check_plan(plan)
    with use_style():
        figure = new_figure(16.0, 2.5 * len(find_groups(plan.trajectory)) + 0.4)
        draw_joints(figure, plan)
    return figure


def plot_clearance(plan: CheckedMotion) -> Figure:
    """Plot the smallest distances over time; the legend names the closest pairs."""
    _check_plan(plan)
    with use_style():
        figure = new_figure(9.0, 4.2)
        _draw_clearance(figure, plan)
    return figure


def plot_top_view(plan: CheckedMotion) -> Figure:
    """Plot the top view: obstacles, objects, the base at several times, paths of base and tool."""
    _check_plan(plan)
    x_min, x_max, y_min, y_max = plan.scene.arena
    with use_style():
        figure = new_figure(
            9.0, float(np.clip(9.0 * (y_max - y_min) / (x_max - x_min) + 0.7, 4.0, 10.0))
        )
        draw_top_view(figure, World(plan.scene), plan.trajectory)
    return figure


def _check_plan(plan: CheckedMotion) -> None:
    if not isinstance(plan, CheckedMotion):
        raise InputError(
            "cannot be plotted", field="plan", expected="a Plan", got=type(plan).__name__
        )


def _plot_all(plan: CheckedMotion) -> Figure:
    with use_style():
        figure = new_figure(16.0, 11.0)
        parts: Any = figure.subfigures(2, 1, height_ratios=(1.15, 1.0))
        upper, lower = parts
        draw_joints(upper, plan)
        left, right = lower.subfigures(1, 2, width_ratios=(1.0, 1.25))
        _draw_clearance(left, plan)
        draw_top_view(right, World(plan.scene), plan.trajectory)
        figure.suptitle(
            f"{plan.scene.name}: {'success' if plan.success else 'FAILED, ' + plan.status}",
            fontweight="bold",
        )
    return figure


def _draw_clearance(figure: FigureBase, plan: CheckedMotion) -> None:
    axes, trajectory = figure.subplots(), plan.trajectory
    times = np.unique(
        np.concatenate(
            [np.linspace(trajectory.times[0], trajectory.times[-1], SAMPLES), trajectory.times]
        )
    )
    safe = plan.options.dist_safe
    lowest = 0.0
    for k, curve in enumerate(compute_clearance_curves(plan.scene, trajectory, times)):
        distance, when, pair = curve.closest()
        touching = "grasps" in curve.name
        colour = "0.6" if touching else COLOURS[k % len(COLOURS)]
        label = f"{curve.name}: {1e3 * distance:.0f} mm, {pair}, {when:.1f} s"
        style: Any = {"linestyle": ":" if touching else "-", "linewidth": 1.5, "label": label}
        axes.plot(curve.times, 1e3 * curve.distances, color=colour, **style)
        if distance < _SHOWN:
            axes.plot([when], [1e3 * distance], "o", color=colour, markersize=4.5)
        lowest = min(lowest, distance)
    axes.axhline(1e3 * safe, color="0.35", **DASHES, label=f"required: {1e3 * safe:.0f} mm")
    if lowest < 0.0:
        axes.axhspan(1e3 * lowest * 1.1, 0.0, color="#d1495b", alpha=0.12, linewidth=0.0)
    axes.set_ylim(1e3 * lowest * 1.1, 1e3 * _SHOWN)
    axes.margins(x=0.0)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("clearance [mm]")
    shade_phases(axes, plan.trajectory)
    name_phases(axes, plan)
    figure.legend(loc="outside lower center", fontsize=7.5, title="closest pairs", title_fontsize=8)
