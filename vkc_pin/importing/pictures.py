"""Draws imported robots and objects, with the proposed attachments and the tool frame."""

from __future__ import annotations

import importlib
import textwrap
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.importing.proposals.proposal import Proposal, Proposals
from vkc_pin.utils.arguments import check_instance
from vkc_pin.utils.arrays import Floats
from vkc_pin.visualization.plots.style import COLOURS, new_figure, save_figure, use_style
from vkc_pin.world.models.articulated_object import ArticulatedObject
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.shapes import get_link_name, triangulate

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_PANELS = 12  # largest number of panels
_COLUMNS = 4
_WIDTH = 3.2  # [inch] of a panel
_FONT = 8  # [pt] of titles and reasons
_LETTERS = 38  # across a panel: rounded to pixels, monospaced ones are up to 0.72 of _FONT wide
_LINE = 1.25 * _FONT / 72.0  # [inch] height of a line of text, with rounding to pixels
_PLACES = 60  # largest number of drawn places that were tried
_ARROW = 0.06  # [m] length of their arrows
_FACET = 0.05  # [m] approximate edge length of drawn triangles
_OPEN = 0.35  # opening of the drawn joint, relative to how far it opens
_LIGHT = np.array([0.35, -0.5, 0.8]) / np.linalg.norm([0.35, -0.5, 0.8])
_STATIC_COLOUR = np.array([0.83, 0.83, 0.81])
_MOVING_COLOUR = np.array([0.93, 0.80, 0.62])
_PLACE_COLOUR = np.array([0.82, 0.29, 0.36])
# Lengths of the tool's axes [m]
_SHORT = 0.08  # in the close-up
_LONG = 0.25  # beside the robot
_AXES = (("x closes", "#d1282e"), ("y", "#2a9d4f"), ("z approaches", "#2f6db5"))
_TOUCH_COLOUR = np.array([0.93, 0.72, 0.45])
_LINK_COLOURS = (np.array([0.80, 0.82, 0.84]), np.array([0.66, 0.71, 0.76]))


def plot_attachments(proposals: Proposals, path: str | Path | None = None) -> Figure:
    """Draw the hand at every proposed attachment, and list the joints that no hand can open.

    Joints are drawn a third open. If there are such joints, the closed object is drawn with its
    size, the links that they move, and the places that were tried, and the reasons are below.

    Args:
        proposals: Result of `propose_attachments`.
        path: Output file (.png, .svg or .pdf); None writes nothing.

    Returns:
        The figure.
    """
    check_instance(proposals, Proposals, "proposals")
    drawn = proposals.found[:_PANELS]
    fails = bool(proposals.because) or not drawn
    panels = len(drawn) + fails
    columns = min(panels, _COLUMNS)
    rows = -(-panels // columns)
    # Reasons stand below all panels, in lines of at least the width of two.
    width = max(columns, 2 if fails else 1)
    lines = _format_reasons(proposals, width * _LETTERS) if fails else []
    panels_height = _WIDTH * rows + 0.3
    reasons_height = _LINE * (len(lines) + 1) if fails else 0.0
    with use_style():
        figure = new_figure(_WIDTH * width, panels_height + reasons_height)
        pictures: Any = figure
        if fails:
            parts: Any = figure.subfigures(2, 1, height_ratios=(panels_height, reasons_height))
            pictures, words = parts
            style = {"fontsize": _FONT, "family": "monospace", "linespacing": 1.2}
            words.text(0.02, 1.0, "\n".join(lines), va="top", **style)
        for number, proposal in enumerate(drawn):
            axes: Any = pictures.add_subplot(rows, columns, number + 1, projection="3d")
            *_, joint = proposal.opens
            _draw(axes, proposals, proposal, joint)
            opened = ", ".join(f"{name} to {value:.2g}" for name, value in proposal.opens.items())
            axes.set_title(
                f"{proposal.attachment.name}  {proposal.score:.2f}\n{opened}", fontsize=_FONT
            )
        if fails:
            whole: Any = pictures.add_subplot(rows, columns, panels, projection="3d")
            _draw_closed(whole, proposals)
        title = f"{proposals.object.name}, hand of {proposals.hand.robot}"
        more = len(proposals.found) - len(drawn)
        if more:
            title += f" ({more} more)"
        pictures.suptitle(title, fontsize=10)
    return save_figure(figure, path)


def _format_reasons(proposals: Proposals, letters: int) -> list[str]:
    """Return lines about the joints that no hand can open; joints of one reason are together."""
    joints_by_reason = dict[str, list[str]]()
    for joint, reason in proposals.because.items():
        joints_by_reason.setdefault(reason, []).append(joint)
    if not joints_by_reason:
        return ["No hand can open it: it has no joints"]
    lines = ["No hand can open"]
    for reason, joints in joints_by_reason.items():
        lines += ["", *textwrap.wrap(f"{', '.join(joints)}: {reason}", letters)]
    return lines


def _draw_closed(axes: Any, proposals: Proposals) -> None:
    """Draw the closed object in metres, with the links and places where no hand could open it."""
    item = proposals.object
    state = np.clip(np.zeros(len(item.lower)), item.lower, item.upper)
    triangles = Triangles()
    _add_object(triangles, item, state, item.links_moved_by(set(proposals.because)))
    places = list[pin.SE3]()
    for tried in proposals.rejected.values():
        places += tried
    direction = np.array([-1.0, 0.0, 0.0])
    if places:
        chosen = places[:: max(1, len(places) // _PLACES)]
        points = np.array([place.translation for place in chosen])
        back = -np.array([place.rotation[:, 2] for place in chosen])
        starts = points + _ARROW * back
        arrows = -_ARROW * back
        axes.quiver(*starts.T, *arrows.T, color=_PLACE_COLOUR, linewidth=0.8)
        axes.scatter(*points.T, color=[_PLACE_COLOUR], s=6, depthshade=False)
        direction = back.mean(axis=0)
    triangles.draw(axes, direction, ticks=True)
    count = f", {len(places)} places tried" if places else ""
    axes.set_title(f"closed{count} [m]", fontsize=_FONT)


def _draw(axes: Any, proposals: Proposals, proposal: Proposal, joint: str) -> None:
    """Draw the object with the hand at one attachment."""
    item = proposals.object
    attachment = proposal.attachment
    state = np.clip(np.zeros(len(item.lower)), item.lower, item.upper)
    for name, value in proposal.when.items():
        state[item.coordinates.index(name)] = value
    index = item.coordinates.index(joint)
    state[index] += _OPEN * (proposal.opens[joint] - state[index])
    triangles = Triangles()
    _add_object(triangles, item, state, item.links_moved_by({joint}))
    in_link = attachment.tool(np.zeros(len(attachment.freedoms)))
    tool = item.link_placement(attachment.link, state) * in_link
    if attachment.contact == "push":
        # It is the frame of the hand's foremost point.
        tool = tool * pin.SE3(np.eye(3), np.array([0.0, 0.0, -proposals.hand.tip]))
    for geometry, where in (*proposals.hand.touch, *proposals.hand.others):
        triangles.add(geometry, tool * where, to_rgb(COLOURS[0]))
    triangles.draw(axes, -tool.rotation[:, 2])


def _add_object(
    triangles: Triangles, item: ArticulatedObject, state: Floats, moving: Collection[str]
) -> None:
    """Add the shapes of an object, in another colour where links move."""
    data = item.model.createData()
    pin.forwardKinematics(item.model, data, item.coordinates.q(state))
    for shape in item.collision.geometryObjects:
        base = _MOVING_COLOUR if get_link_name(shape.name) in moving else _STATIC_COLOUR
        triangles.add(shape.geometry, data.oMi[shape.parentJoint] * shape.placement, base)


class Triangles:
    """Shaded triangles of shapes, to be drawn into axes in three dimensions."""

    def __init__(self) -> None:
        self._faces = list[Floats]()
        self._colours = list[Floats]()

    def add(self, geometry: coal.CollisionGeometry, where: pin.SE3, base: Floats) -> None:
        """Add a shape with a colour, shape (3,)."""
        import trimesh

        vertices, corners = triangulate(geometry)
        size = float(np.ptp(vertices, axis=0).max())
        # matplotlib would draw large triangles in the wrong order.
        if size > _FACET:
            vertices, corners = trimesh.remesh.subdivide_to_size(
                vertices, corners, max(_FACET, size / 12.0), max_iter=20
            )
        placed = (vertices @ where.rotation.T + where.translation)[corners]
        normals = np.cross(placed[:, 1] - placed[:, 0], placed[:, 2] - placed[:, 0])
        lengths = np.linalg.norm(normals, axis=1)
        shade = 0.62 + 0.38 * np.abs(normals @ _LIGHT) / np.maximum(lengths, 1e-12)
        self._faces.append(placed)
        self._colours.append(np.clip(shade[:, None] * base, 0.0, 1.0))

    def draw(self, axes: Any, towards: Floats, *, ticks: bool = False) -> None:
        """Draw all triangles, if there are any.

        Args:
            axes: Axes in three dimensions.
            towards: Direction to the viewer, shape (3,); its height is ignored.
            ticks: Whether to draw the axes [m].
        """
        if not self._faces:
            return
        # The module has no type annotations.
        collection = importlib.import_module("mpl_toolkits.mplot3d.art3d").Poly3DCollection

        triangles = np.concatenate(self._faces)
        shades = np.concatenate(self._colours)
        axes.add_collection3d(
            collection(triangles, facecolors=shades, edgecolors="none", shade=False)
        )
        points = triangles.reshape(-1, 3)
        low = points.min(axis=0)
        high = points.max(axis=0)
        # A cube, so that lengths along all axes look alike
        x, y, z = (low + high) / 2.0
        half = float((high - low).max()) / 2.0
        axes.set_xlim(x - half, x + half)
        axes.set_ylim(y - half, y + half)
        axes.set_zlim(z - half, z + half)
        level = float(np.linalg.norm(towards[:2]))
        azimuth = np.degrees(np.arctan2(towards[1], towards[0])) if level > 0.3 else -120.0
        axes.view_init(elev=25.0, azim=azimuth + 40.0)
        axes.set_box_aspect((1.0, 1.0, 1.0), zoom=1.0 if ticks else 1.45)
        if ticks:
            axes.tick_params(labelsize=6, pad=-2)
        else:
            axes.set_axis_off()


def to_rgb(colour: str) -> Floats:
    """Return red, green and blue of a colour's name, shape (3,), from 0 to 1."""
    from matplotlib import colors

    return np.array(colors.to_rgb(colour))


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
    frame = robot.model.getFrameId(robot.tool_frame)
    tool = data.oMf[frame]
    wrist = robot.model.frames[frame].parentJoint
    everything = Triangles()
    hand = Triangles()
    counts = dict[str, int]()  # of the pieces of a link so far
    for k, shape in enumerate(robot.collision.geometryObjects):
        link = robot.link_of(k)
        number = counts.get(link, 0)
        counts[link] = number + 1
        colour = _TOUCH_COLOUR if link in robot.touch_links else _LINK_COLOURS[number % 2]
        placement = data.oMi[shape.parentJoint] * shape.placement
        everything.add(shape.geometry, placement, colour)
        if shape.parentJoint == wrist:
            hand.add(shape.geometry, placement, colour)
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
                end = tool.translation + length * tool.rotation[:, axis]
                line = np.array([tool.translation, end]).T
                axes.plot(*line, color=to_rgb(paint), linewidth=2.0, label=name, zorder=10)
            axes.set_title(f"{title} [m]", fontsize=9)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
        opening = f", open {1e3 * robot.gripper.max_opening:.0f} mm" if robot.gripper else ""
        pieces = len(robot.collision.geometryObjects)
        figure.suptitle(f"{robot.name}: {pieces} convex pieces{opening}", fontsize=10)
    return save_figure(figure, path)
