"""Draws an imported robot, so that what was guessed can be seen."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from vkc_pin.importing.proposals.picture import Triangles, to_rgb
from vkc_pin.visualization.plots.style import new_figure, save_figure, use_style
from vkc_pin.world.models.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["plot_robot"]

_SHORT, _LONG = 0.08, 0.25  # [m] lengths of the tool's axes in the close-up and beside the robot
_AXES = (("x closes", "#d1282e"), ("y", "#2a9d4f"), ("z approaches", "#2f6db5"))
_TOUCH_COLOUR = np.array([0.93, 0.72, 0.45])
_LINK_COLOURS = (np.array([0.80, 0.82, 0.84]), np.array([0.66, 0.71, 0.76]))


def plot_robot(robot: Robot, path: str | Path | None = None) -> Figure:
    """Draw the convex pieces of a robot at home with open fingers, and its tool frame.

    Pieces of the hand that may touch a grasped object are orange. A second panel shows the
    link with the tool frame.

    Args:
        robot: The robot.
        path: Output file (.png, .svg or .pdf); None writes nothing.

    Returns:
        The figure.
    """
    data = robot.model.createData()
    q = robot.coordinates.q(np.concatenate([np.zeros(3), robot.home]))
    pin.framesForwardKinematics(robot.model, data, q)
    tool = data.oMf[robot.model.getFrameId(robot.tool_frame)]
    wrist = robot.model.frames[robot.model.getFrameId(robot.tool_frame)].parentJoint
    everything, hand, count = Triangles(), Triangles(), dict[str, int]()
    for k, shape in enumerate(robot.collision.geometryObjects):
        link = robot.link_of(k)
        number = count[link] = count.get(link, -1) + 1
        colour = _TOUCH_COLOUR if link in robot.touch_links else _LINK_COLOURS[number % 2]
        for triangles in (everything, hand)[: 1 + (shape.parentJoint == wrist)]:
            triangles.add(shape.geometry, data.oMi[shape.parentJoint] * shape.placement, colour)
    with use_style():
        figure = new_figure(9.0, 4.8)
        panels = (
            ("at home", _LONG, everything),
            (f"last link, frame '{robot.tool_frame}'", _SHORT, hand),
        )
        for number, (title, length, triangles) in enumerate(panels, 1):
            axes: Any = figure.add_subplot(1, 2, number, projection="3d", computed_zorder=False)
            triangles.draw(axes, np.array([1.0, -1.0, 0.0]), ticks=True)
            for axis, (name, paint) in enumerate(_AXES):
                ends = tool.translation, tool.translation + length * tool.rotation[:, axis]
                line = np.array(ends).T
                axes.plot(*line, color=to_rgb(paint), linewidth=2.0, label=name, zorder=10)
            axes.set_title(f"{title} [m]", fontsize=9)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
        opening = f", open {1e3 * robot.gripper.max_opening:.0f} mm" if robot.gripper else ""
        pieces = len(robot.collision.geometryObjects)
        figure.suptitle(f"{robot.name}: {pieces} convex pieces{opening}", fontsize=10)
    return save_figure(figure, path)
