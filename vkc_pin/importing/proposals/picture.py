"""Plots the hand at each proposed attachment of an object."""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.importing.proposals.proposal import Proposal, Proposals
from vkc_pin.utils.arguments import check_instance
from vkc_pin.utils.arrays import Floats
from vkc_pin.visualization.plots.style import COLOURS, new_figure, save_figure, use_style
from vkc_pin.world.models.shapes import get_link_name, triangulate

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["plot_attachments"]

_PANELS = 12  # largest number of panels
_COLUMNS = 4
_WIDTH = 3.2  # [inch] of a panel
_FACET = 0.05  # [m] approximate edge length of drawn triangles
_OPEN = 0.35  # opening of the drawn joint, relative to how far it opens
_LIGHT = np.array([0.35, -0.5, 0.8]) / np.linalg.norm([0.35, -0.5, 0.8])
_STATIC_COLOUR, _MOVING_COLOUR, _HELD_COLOUR = (
    np.array([0.83, 0.83, 0.81]),
    np.array([0.93, 0.80, 0.62]),
    np.array([0.82, 0.29, 0.36]),
)


def plot_attachments(proposals: Proposals, path: str | Path | None = None) -> Figure:
    """Draw the hand at every proposed attachment, and list the joints that no hand can open.

    Joints are drawn a third open.

    Args:
        proposals: Result of `propose_attachments`.
        path: Output file (.png, .svg or .pdf); None writes nothing.

    Returns:
        The figure.
    """
    check_instance(proposals, Proposals, "proposals")
    drawn = proposals.found[:_PANELS]
    panels = max(1, len(drawn) + bool(proposals.because))
    columns = min(panels, _COLUMNS)
    rows = -(-panels // columns)
    with use_style():
        figure = new_figure(_WIDTH * columns, _WIDTH * rows + 0.3)
        for number, proposal in enumerate(drawn):
            axes: Any = figure.add_subplot(rows, columns, number + 1, projection="3d")
            joint = list(proposal.opens)[-1]
            _draw(axes, proposals, proposal, joint)
            opened = ", ".join(f"{name} to {value:.2g}" for name, value in proposal.opens.items())
            axes.set_title(
                f"{proposal.attachment.name}  {proposal.score:.2f}\n{opened}", fontsize=8
            )
        if proposals.because or not drawn:
            words: Any = figure.add_subplot(rows, columns, panels)
            words.axis("off")
            reasons = (
                "\n\n".join(f"{joint}: {reason}" for joint, reason in proposals.because.items())
                or "it has no joints"
            )
            words.text(0.0, 1.0, "No hand can open\n\n" + reasons, va="top", wrap=True, fontsize=8)
        more = len(proposals.found) - len(drawn)
        figure.suptitle(
            f"{proposals.object.name}, hand of {proposals.hand.robot}"
            + (f" ({more} more)" if more else ""),
            fontsize=10,
        )
    return save_figure(figure, path)


def _draw(axes: Any, proposals: Proposals, proposal: Proposal, joint: str) -> None:
    """Draw the object with the hand at one attachment."""
    item, attachment = proposals.object, proposal.attachment
    state = np.clip(np.zeros(len(item.lower)), item.lower, item.upper)
    for name, value in proposal.when.items():
        state[item.coordinates.index(name)] = value
    index = item.coordinates.index(joint)
    state[index] += _OPEN * (proposal.opens[joint] - state[index])
    data = item.model.createData()
    pin.forwardKinematics(item.model, data, item.coordinates.q(state))
    moving, faces, colours = item.links_moved_by({joint}), list[Floats](), list[Floats]()
    for shape in item.collision.geometryObjects:
        base = _MOVING_COLOUR if get_link_name(shape.name) in moving else _STATIC_COLOUR
        _add_shape(
            faces, colours, shape.geometry, data.oMi[shape.parentJoint] * shape.placement, base
        )
    tool = item.link_placement(attachment.link, state) * attachment.tool(
        np.zeros(len(attachment.freedoms))
    )
    for geometry, where in (*proposals.hand.touch, *proposals.hand.others):
        _add_shape(faces, colours, geometry, tool * where, np.array(_to_rgb(COLOURS[0])))
    _add_triangles(axes, faces, colours, tool)


def _add_shape(
    faces: list[Floats],
    colours: list[Floats],
    geometry: coal.CollisionGeometry,
    where: pin.SE3,
    base: Floats,
) -> None:
    import trimesh

    vertices, corners = triangulate(geometry)
    # matplotlib would draw large triangles in the wrong order.
    if (size := float(np.ptp(vertices, axis=0).max())) > _FACET:
        vertices, corners = trimesh.remesh.subdivide_to_size(
            vertices, corners, max(_FACET, size / 12.0), max_iter=20
        )
    placed = (vertices @ where.rotation.T + where.translation)[corners]
    normals = np.cross(placed[:, 1] - placed[:, 0], placed[:, 2] - placed[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    shade = 0.62 + 0.38 * np.abs(normals @ _LIGHT) / np.maximum(lengths, 1e-12)
    faces.append(placed)
    colours.append(np.clip(shade[:, None] * base, 0.0, 1.0))


def _add_triangles(
    axes: Any, faces: Iterable[Floats], colours: Iterable[Floats], tool: pin.SE3
) -> None:
    """Add triangles to axes, viewed from the side of the hand."""
    # The module has no type annotations.
    collection = importlib.import_module("mpl_toolkits.mplot3d.art3d").Poly3DCollection

    triangles, shades = np.concatenate(list(faces)), np.concatenate(list(colours))
    axes.add_collection3d(collection(triangles, facecolors=shades, edgecolors="none", shade=False))
    low, high = triangles.reshape(-1, 3).min(axis=0), triangles.reshape(-1, 3).max(axis=0)
    middle, half = (low + high) / 2.0, float((high - low).max()) / 2.0
    for set_limits, centre in zip(
        (axes.set_xlim, axes.set_ylim, axes.set_zlim), middle, strict=True
    ):
        set_limits(centre - half, centre + half)
    back = -tool.rotation[:, 2]
    azimuth = np.degrees(np.arctan2(back[1], back[0])) if np.linalg.norm(back[:2]) > 0.3 else -120.0
    axes.view_init(elev=25.0, azim=azimuth + 40.0)
    axes.set_box_aspect((1.0, 1.0, 1.0), zoom=1.45)
    axes.set_axis_off()


def _to_rgb(colour: str) -> tuple[float, float, float]:
    from matplotlib.colors import to_rgb

    red, green, blue = to_rgb(colour)
    return float(red), float(green), float(blue)
