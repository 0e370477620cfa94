"""Draws a top view of a scene with the motion of base, tool and objects."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.shapes import triangulate
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.trajectory.placements import sample_motion
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase


_STEP = 0.55  # travel between two drawn footprints [m]
_ROBOT_HEIGHT = 1.8  # obstacles above this height are drawn dashed [m]
_START, _END, _TOOL, _BASE = "#3a6bc4", "#1a9961", "#e03359", "#2b5f9e"


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
    for i, shape in enumerate(world.shapes):
        if shape.parentJoint or world.collision_labels[i] == FLOOR:
            continue
        points = _place_vertices(world, i, np.eye(4), {})
        high = points[:, 2].min() > _ROBOT_HEIGHT
        paint = (*np.clip(shape.meshColor[:3], 0.0, 1.0), 0.75)
        style: dict[str, Any] = {"fill": False, "linestyle": "--"} if high else {"facecolor": paint}
        axes.add_patch(
            Polygon(compute_outline(points), edgecolor="0.45", linewidth=0.7, zorder=1, **style)
        )

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
    shades = LinearSegmentedColormap.from_list("time", [_START, _END])(
        np.linspace(0.0, 1.0, len(times))
    )
    robot, moving = [], []
    cache: dict[int, Floats] = {}
    for i, shape in enumerate(world.shapes):
        if shape.parentJoint == 1:
            robot.append(i)
        elif shape.parentJoint and "." in world.collision_labels[i]:
            moving.append(i)
    for k, colour in enumerate(shades):
        ends = k in (0, len(times) - 1)
        base = np.concatenate([_place_vertices(world, i, motion.world[k, 1], cache) for i in robot])
        drawn = {"edgecolor": colour, "linewidth": 1.6 if ends else 0.8, "zorder": 3}
        label = "start" if k == 0 else "end" if k == len(times) - 1 else None
        axes.add_patch(
            Polygon(
                compute_outline(base),
                facecolor=(*colour[:3], 0.22 if ends else 0.05),
                label=label,
                **drawn,
            )
        )
        if ends:
            tail, nose = (
                motion.world[k, 1] @ np.array([[0.0, 0.0, 0.0, 1.0], [0.45, 0.0, 0.0, 1.0]]).T
            )[:2].T
            arrow = {"arrowstyle": "->", "color": colour, "linewidth": 1.6}
            axes.annotate("", nose, tail, arrowprops=arrow, zorder=4)
        for i in moving:
            joint = world.shapes[i].parentJoint
            if not ends and np.allclose(
                motion.world[k, joint], motion.world[k - 1, joint], atol=1e-3
            ):
                continue
            corners = _place_vertices(world, i, motion.world[k, joint], cache)
            axes.add_patch(
                Polygon(
                    compute_outline(corners),
                    facecolor=(*colour[:3], 0.35 if ends else 0.1),
                    **drawn,
                )
            )
    if trajectory is None:
        return
    fine = sample_motion(
        world, trajectory, np.linspace(trajectory.times[0], trajectory.times[-1], 400)
    )
    paths = (("base", fine.base, _BASE), ("tool", fine.tool, _TOOL))
    for name, path, colour in paths:
        label = f"path of the {name}"
        axes.plot(*path[:, :2].T, color=colour, linewidth=1.6, zorder=4, label=label)
    for _, path, colour in paths:
        axes.plot(*path[0, :2], "o", color=colour, markersize=4.5, zorder=5)
        axes.plot(*path[-1, :2], "s", color=colour, markersize=4.5, zorder=5)


def _choose_times(trajectory: Trajectory) -> Floats:
    """Choose times at equal steps of the travel of base and objects."""
    fine = np.linspace(trajectory.times[0], trajectory.times[-1], 400)
    rows = trajectory.at(fine)
    objects = np.abs(np.diff(rows[:, trajectory.robot_size :], axis=0)).sum(axis=1)
    travel = (
        np.hypot(*np.diff(rows[:, :2], axis=0).T)
        + 0.3 * np.abs(np.diff(rows[:, 2]))
        + 0.5 * objects
    )
    passed = np.concatenate([[0.0], np.cumsum(travel)])
    count = int(np.clip(np.ceil(passed[-1] / _STEP), 1, 14))
    return (
        np.unique(np.interp(np.linspace(0.0, passed[-1], count + 1), passed, fine))
        if passed[-1] > 0.0
        else fine[[0, -1]]
    )


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
