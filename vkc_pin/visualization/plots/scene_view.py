"""Plots a top view of a scene with approach directions of grasps and penetrating links."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.utils.arrays import Floats
from vkc_pin.visualization.plots.plots import PICTURES
from vkc_pin.visualization.plots.style import COLOURS, new_figure, save_figure, use_style
from vkc_pin.visualization.plots.top_view import compute_outline, draw_top_view
from vkc_pin.world.files.resources import check_path
from vkc_pin.world.models.shapes import triangulate
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.world_model import World

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_ARROW = 0.35  # [m]
_MARGIN, _BEYOND = 0.3, 0.1  # [m] around the content, and around labels
_LARGE, _SMALL = 7.0, 2.5  # [inch] longer side of the plan, and smallest length of the other
_FRAME, _LEGEND = 0.8, 2.6  # [inch] for labels of the axes, and for the legend
_LETTERS = 40  # in a line of the legend
_BESIDE = 0.4  # largest distance between arrows that share a label [m]


class Approach(NamedTuple):
    """An approach of the hand to an attachment.

    Attributes:
        name: Name of the attachment, "<object>.<attachment>".
        at: Position of the tool at the grasp, shape (3,) [m].
        direction: Direction of the approach, shape (3,).
        base: Base pose x, y [m] and yaw [rad], shape (3,); None if the grasp is not reachable.
    """

    name: str
    at: Floats
    direction: Floats
    base: Floats | None


def plot_scene(
    scene: Scene,
    approaches: Sequence[Approach] = (),
    stuck: Sequence[str] = (),
    path: str | Path | None = None,
) -> Figure:
    """Draw a scene from above, with numbered attachments and a legend of their names.

    Args:
        scene: Scene to draw.
        approaches: Arrows to draw: blue with a dot at the base if reachable, otherwise red.
        stuck: Labels of links and obstacles to outline in red.
        path: Picture to write, ending with .png, .svg or .pdf. Default: no file.

    Raises:
        InputError: `path` has another extension.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Polygon

    target = None if path is None else check_path(path, "path")
    if target is not None and target.suffix.lower() not in PICTURES:
        raise InputError(
            "not the name of a picture",
            field="path",
            expected=f"one that ends with {', '.join(PICTURES)}",
            got=path,
        )
    world, (blue, red) = World(scene), COLOURS[:2]
    with use_style():
        figure = new_figure(_LARGE, _LARGE)
        draw_top_view(figure, world, None)
        axes = figure.axes[0]
        data = world.model.createData()
        pin.forwardKinematics(world.model, data, world.coordinates.q(world.start))
        for label, shape in zip(world.collision_labels, world.shapes, strict=True):
            if label in stuck and label != FLOOR:
                where = data.oMi[shape.parentJoint] * shape.placement
                corners = triangulate(shape.geometry)[0] @ where.rotation.T + where.translation
                axes.add_patch(
                    Polygon(
                        compute_outline(corners), fill=False, edgecolor=red, linewidth=2.0, zorder=6
                    )
                )
        names: list[tuple[str, tuple[float, float], tuple[str, str]]] = []
        for name, at, direction, base in approaches:
            (x, y), (u, v) = at[:2].tolist(), (at[:2] - _ARROW * direction[:2]).tolist()
            colour = red if base is None else blue
            arrow = {"arrowstyle": "->", "color": colour, "linewidth": 1.8}
            axes.annotate("", (x, y), (u, v), arrowprops=arrow, zorder=7)
            owner, _, own = name.partition(".")
            beside = (
                k
                for k, (_, place, one) in enumerate(names)
                if one == (owner, colour) and math.dist(place, (u, v)) < _BESIDE
            )
            k = next(beside, None)
            if k is None:
                names.append((name, (u, v), (owner, colour)))
            else:
                names[k] = (f"{names[k][0]}, {own}", *names[k][1:])
            if base is not None:
                axes.plot([base[0], x], [base[1], y], ":", color=colour, linewidth=0.8, zorder=5)
                axes.plot(base[0], base[1], "o", color=colour, markersize=4, zorder=7)
        for number, (_, place, (_, colour)) in enumerate(names, 1):
            axes.annotate(str(number), place, color=colour, fontsize=8, weight="bold", zorder=8)
        _fit(figure, [place for _, place, _ in names], bool(names))
        if names:
            handles = [
                Line2D([], [], linestyle="", marker=f"${k}$", color=colour, label=_wrap(text))
                for k, (text, _, (_, colour)) in enumerate(names, 1)
            ]
            figure.legend(handles=handles, loc="outside right upper", fontsize=7)
        return save_figure(figure, target)


def _fit(figure: Figure, places: Sequence[tuple[float, float]], has_legend: bool) -> None:
    """Set the limits to the content within the arena, and the figure's size to their ratio."""
    (axes,) = figure.axes
    low, high = np.array(axes.dataLim.min), np.array(axes.dataLim.max)
    arena = np.array([axes.get_xlim(), axes.get_ylim()]).T
    low, high = np.maximum(low - _MARGIN, arena[0]), np.minimum(high + _MARGIN, arena[1])
    if places:
        low = np.minimum(low, np.min(places, axis=0) - _BEYOND)
        high = np.maximum(high, np.max(places, axis=0) + _BEYOND)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    width, height = np.maximum(_LARGE * (high - low) / (high - low).max(), _SMALL)
    figure.set_size_inches(width + _FRAME + _LEGEND * has_legend, height + _FRAME)


def _wrap(text: str) -> str:
    return textwrap.fill(text, _LETTERS)
