"""Draws a top view of a scene with the motion of base, tool and objects."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.collision.point_cloud import PointCloud, select_for_drawing
from vkc_pin.world.models.shapes import triangulate
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.trajectory.placements import sample_motion
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase


# [m] travel between two drawn footprints
_STEP = 0.55
# at most so many steps
_MAX_STEPS = 14
# [m] obstacles above this height are drawn dashed
_ROBOT_HEIGHT = 1.8
# [m] length of the arrow that shows the heading
_ARROW = 0.45
# times at which paths are drawn
_SAMPLES = 400
# points of measured obstacles that are drawn
_MAX_DRAWN_POINTS = 50_000
# colours of footprints at both ends, and of paths
_START = "#3a6bc4"
_END = "#1a9961"
_TOOL = "#e03359"
_BASE = "#2b5f9e"


def draw_top_view(
    figure: FigureBase, world: World, trajectory: Trajectory | None, *, columns: int = 4
) -> None:
    """Draw a top view of the collision geometry into an empty figure.

    Args:
        figure: Figure to draw into.
        world: World of the scene.
        trajectory: Motion; None draws the scene's start.
        columns: Number of columns of the legend.
    """
    from matplotlib.patches import Polygon

    axes = figure.subplots()
    clouds: list[Floats] = []
    for i, shape in enumerate(world.shapes):
        if shape.parentJoint or world.collision_labels[i] == FLOOR:
            continue
        if isinstance(shape.geometry, PointCloud):
            clouds.append(shape.geometry.place(shape.placement))
            continue
        points = _place_vertices(world, i, np.eye(4), {})
        style: dict[str, Any] = {"edgecolor": "0.45", "linewidth": 0.7, "zorder": 1}
        if points[:, 2].min() > _ROBOT_HEIGHT:
            style["fill"] = False
            style["linestyle"] = "--"
        else:
            style["facecolor"] = (*np.clip(shape.meshColor[:3], 0.0, 1.0), 0.75)
        axes.add_patch(Polygon(compute_outline(points), **style))

    if clouds:
        drawn = select_for_drawing(np.concatenate(clouds), _MAX_DRAWN_POINTS)
        axes.plot(*drawn[:, :2].T, ",", color="0.45", zorder=1, rasterized=True)
    _draw_motion(axes, world, trajectory)
    x_min, x_max, y_min, y_max = world.scene.arena
    axes.set_xlim(x_min - 0.1, x_max + 0.1)
    axes.set_ylim(y_min - 0.1, y_max + 0.1)
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.set_axisbelow(True)
    figure.legend(loc="outside upper center", ncols=columns, fontsize=8)


def _draw_motion(axes: Axes, world: World, trajectory: Trajectory | None) -> None:
    """Draw moving bodies at several times, and the paths of base and tool."""
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.patches import Polygon

    times = np.zeros(1) if trajectory is None else _choose_times(trajectory)
    motion = sample_motion(world, trajectory, times)
    colours = LinearSegmentedColormap.from_list("time", [_START, _END])
    base_shapes: list[int] = []
    object_shapes: list[int] = []
    for i, shape in enumerate(world.shapes):
        if shape.parentJoint == 1:
            base_shapes.append(i)
        elif shape.parentJoint and "." in world.collision_labels[i]:
            object_shapes.append(i)
    cache: dict[int, Floats] = {}
    for k, colour in enumerate(colours(np.linspace(0.0, 1.0, len(times)))):
        is_end = k in (0, len(times) - 1)
        style = {"edgecolor": colour, "linewidth": 1.6 if is_end else 0.8, "zorder": 3}
        base = motion.world[k, 1]
        corners = np.concatenate([_place_vertices(world, i, base, cache) for i in base_shapes])
        label = None
        if is_end:
            label = "start" if k == 0 else "end"
        paint = (*colour[:3], 0.22 if is_end else 0.05)
        axes.add_patch(Polygon(compute_outline(corners), facecolor=paint, label=label, **style))
        if is_end:
            # The columns are the ends of the arrow in the base's frame.
            ends = base @ np.array([[0.0, 0.0, 0.0, 1.0], [_ARROW, 0.0, 0.0, 1.0]]).T
            tail, nose = ends[:2].T
            arrow = {"arrowstyle": "->", "color": colour, "linewidth": 1.6}
            axes.annotate("", nose, tail, arrowprops=arrow, zorder=4)
        for i in object_shapes:
            joint = world.shapes[i].parentJoint
            placement = motion.world[k, joint]
            if not is_end and np.allclose(placement, motion.world[k - 1, joint], atol=1e-3):
                continue
            corners = _place_vertices(world, i, placement, cache)
            paint = (*colour[:3], 0.35 if is_end else 0.1)
            axes.add_patch(Polygon(compute_outline(corners), facecolor=paint, **style))
    if trajectory is not None:
        _draw_paths(axes, world, trajectory)


def _draw_paths(axes: Axes, world: World, trajectory: Trajectory) -> None:
    """Draw the paths of base and tool, with a dot at the start and a square at the end."""
    times = np.linspace(trajectory.times[0], trajectory.times[-1], _SAMPLES)
    motion = sample_motion(world, trajectory, times)
    paths = (("base", motion.base, _BASE), ("tool", motion.tool, _TOOL))
    for name, path, colour in paths:
        label = f"path of the {name}"
        axes.plot(*path[:, :2].T, color=colour, linewidth=1.6, zorder=4, label=label)
    for _, path, colour in paths:
        axes.plot(*path[0, :2], "o", color=colour, markersize=4.5, zorder=5)
        axes.plot(*path[-1, :2], "s", color=colour, markersize=4.5, zorder=5)


def _choose_times(trajectory: Trajectory) -> Floats:
    """Choose times at equal steps of the travel of base and objects."""
    times = np.linspace(trajectory.times[0], trajectory.times[-1], _SAMPLES)
    positions = trajectory.at(times)
    drive = np.hypot(*np.diff(positions[:, :2], axis=0).T)
    turn = np.abs(np.diff(positions[:, 2]))
    objects = np.abs(np.diff(positions[:, trajectory.robot_size :], axis=0)).sum(axis=1)
    travel = np.concatenate([[0.0], np.cumsum(drive + 0.3 * turn + 0.5 * objects)])
    total = travel[-1]
    if not total > 0.0:
        return times[[0, -1]]
    count = int(np.clip(np.ceil(total / _STEP), 1, _MAX_STEPS))
    return np.unique(np.interp(np.linspace(0.0, total, count + 1), travel, times))


def _place_vertices(world: World, index: int, joint: Floats, cache: dict[int, Floats]) -> Floats:
    """Return a shape's vertices, (n, 3) [m], for joint placement (4, 4); cache triangulations."""
    shape = world.shapes[index]
    if index not in cache:
        cache[index] = triangulate(shape.geometry)[0]
    placed = pin.SE3(joint) * shape.placement
    return np.asarray(cache[index] @ np.asarray(placed.rotation).T + placed.translation)


def compute_outline(points: Floats) -> Floats:
    """Compute the convex hull, shape (k, 2), of the x and y of points, shape (n, ≥ 2)."""
    from scipy.spatial import ConvexHull, QhullError

    flat = np.unique(np.round(points[:, :2], 6), axis=0)
    try:
        return np.asarray(flat[ConvexHull(flat).vertices])
    except QhullError:  # all on one line
        return np.asarray(flat[[0, -1]])
