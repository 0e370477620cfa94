"""Plots a top view of a scene with approach directions of grasps and penetrating links."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
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
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# [m] length of arrows
_ARROW = 0.35
# [m] around the content, and around labels
_MARGIN = 0.3
_LABEL_MARGIN = 0.1
# [inch] longer side of the plan, and smallest length of the other
_LARGE = 7.0
_SMALL = 2.5
# [inch] for labels of the axes, and for the legend
_FRAME = 0.8
_LEGEND = 2.6
# in a line of the legend
_LETTERS = 40
# [m] largest distance between arrows that share a label
_BESIDE = 0.4


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
    target = None if path is None else check_path(path, "path")
    if target is not None and target.suffix.lower() not in PICTURES:
        raise InputError(
            "not the name of a picture",
            field="path",
            expected=f"one that ends with {', '.join(PICTURES)}",
            got=path,
        )
    world = World(scene)
    with use_style():
        figure = new_figure(_LARGE, _LARGE)
        draw_top_view(figure, world, None)
        axes = figure.axes[0]
        _outline_links(axes, world, stuck)
        labels: list[_Label] = []
        for approach in approaches:
            _draw_approach(axes, approach)
            _add_label(labels, approach)
        for number, label in enumerate(labels, 1):
            axes.annotate(
                str(number), label.at, color=label.colour, fontsize=8, weight="bold", zorder=8
            )
        _fit(figure, [label.at for label in labels])
        if labels:
            _add_legend(figure, labels)
        return save_figure(figure, target)


@dataclass
class _Label:
    """A numbered label at arrows that share it.

    Attributes:
        text: Names of the attachments.
        owner: Their object.
        at: Position, x and y [m].
        colour: Colour of the arrows.
    """

    text: str
    owner: str
    at: tuple[float, float]
    colour: str


def _choose_colour(approach: Approach) -> str:
    """Return the colour of an approach: blue if it is reachable, else red."""
    blue, red = COLOURS[:2]
    return red if approach.base is None else blue


def _find_tail(approach: Approach) -> tuple[float, float]:
    """Return where the arrow of an approach begins, x and y [m]."""
    x, y = (approach.at[:2] - _ARROW * approach.direction[:2]).tolist()
    return x, y


def _outline_links(axes: Axes, world: World, labels: Sequence[str]) -> None:
    """Outline links and obstacles in red."""
    from matplotlib.patches import Polygon

    red = COLOURS[1]
    data = world.model.createData()
    pin.forwardKinematics(world.model, data, world.coordinates.q(world.start))
    for label, shape in zip(world.collision_labels, world.shapes, strict=True):
        if label not in labels or label == FLOOR:
            continue
        placement = data.oMi[shape.parentJoint] * shape.placement
        vertices, _ = triangulate(shape.geometry)
        corners = vertices @ placement.rotation.T + placement.translation
        outline = compute_outline(corners)
        axes.add_patch(Polygon(outline, fill=False, edgecolor=red, linewidth=2.0, zorder=6))


def _draw_approach(axes: Axes, approach: Approach) -> None:
    """Draw the arrow of an approach, and a line from the base if it is reachable."""
    colour = _choose_colour(approach)
    x, y = approach.at[:2].tolist()
    arrow = {"arrowstyle": "->", "color": colour, "linewidth": 1.8}
    axes.annotate("", (x, y), _find_tail(approach), arrowprops=arrow, zorder=7)
    if approach.base is not None:
        base_x, base_y = approach.base[:2]
        axes.plot([base_x, x], [base_y, y], ":", color=colour, linewidth=0.8, zorder=5)
        axes.plot(base_x, base_y, "o", color=colour, markersize=4, zorder=7)


def _add_label(labels: list[_Label], approach: Approach) -> None:
    """Add an approach to a label beside it, or a new label."""
    owner, _, attachment = approach.name.partition(".")
    colour = _choose_colour(approach)
    tail = _find_tail(approach)
    for label in labels:
        is_alike = label.owner == owner and label.colour == colour
        if is_alike and math.dist(label.at, tail) < _BESIDE:
            label.text = f"{label.text}, {attachment}"
            return
    labels.append(_Label(approach.name, owner, tail, colour))


def _add_legend(figure: Figure, labels: Sequence[_Label]) -> None:
    """Add a legend of numbers and names."""
    from matplotlib.lines import Line2D

    handles: list[Line2D] = []
    for number, label in enumerate(labels, 1):
        text = textwrap.fill(label.text, _LETTERS)
        handles.append(
            Line2D([], [], linestyle="", marker=f"${number}$", color=label.colour, label=text)
        )
    figure.legend(handles=handles, loc="outside right upper", fontsize=7)


def _fit(figure: Figure, places: Sequence[tuple[float, float]]) -> None:
    """Set the limits to the content within the arena, and the figure's size to their ratio.

    Args:
        figure: Figure of one plot.
        places: Positions of labels, which need a legend.
    """
    (axes,) = figure.axes
    arena_low, arena_high = np.array([axes.get_xlim(), axes.get_ylim()]).T
    low = np.maximum(np.array(axes.dataLim.min) - _MARGIN, arena_low)
    high = np.minimum(np.array(axes.dataLim.max) + _MARGIN, arena_high)
    if places:
        low = np.minimum(low, np.min(places, axis=0) - _LABEL_MARGIN)
        high = np.maximum(high, np.max(places, axis=0) + _LABEL_MARGIN)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    width, height = np.maximum(_LARGE * (high - low) / (high - low).max(), _SMALL)
    legend = _LEGEND if places else 0.0
    figure.set_size_inches(width + _FRAME + legend, height + _FRAME)
