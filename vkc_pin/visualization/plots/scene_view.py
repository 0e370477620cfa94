"""Plots a top view of a scene with approach directions of grasps and penetrating links."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

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

__all__ = ["Approach", "plot_scene"]

_ARROW = 0.35  # [m]
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
    """Draw a scene from above.

    Args:
        scene: Scene to draw.
        approaches: Arrows to draw: blue with a dot at the base if reachable, otherwise red.
        stuck: Labels of links and obstacles to outline in red.
        path: Picture to write, ending with .png, .svg or .pdf. Default: no file.

    Raises:
        InputError: `path` has another extension.
    """
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
        figure = new_figure(8.0, 8.0)
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
        for text, place, (_, colour) in names:  # one for all that come from one side of an object
            axes.annotate(text, place, color=colour, fontsize=7, zorder=7)
        return save_figure(figure, target)
