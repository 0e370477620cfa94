"""Plots joints and clearance over time, and the top view of a motion, with matplotlib.

Figures are made without pyplot: they need no screen, and none stays open.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.validation.collisions import PairTable
from vkc_pin.validation.distances import CollisionShapes
from vkc_pin.validation.report import CheckedMotion
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
from vkc_pin.world.scene.clearance_exemptions import find_clearance_exemptions
from vkc_pin.world.scene.contact_rules import find_grasped_link, find_touch_links
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, FigureBase


_KINDS = (
    "robot – itself",
    "robot – objects",
    "robot – obstacles",
    "objects – surroundings",
    "gripper – grasped object",
)
SAMPLES = 240
"""Number of times at which a motion is drawn, besides its waypoints and knots."""
_BEFORE = 1e-9  # offset before a knot, where accelerations jump [s]
DASHES: Any = {"linestyle": (0, (5, 3)), "linewidth": 0.9}
"""Style of limits."""
PICTURES = (".png", ".svg", ".pdf")
"""File name extensions of pictures."""
_SHOWN = 0.30  # larger clearances are cut off [m]


@dataclass(frozen=True, eq=False)
class ClearanceCurve:
    """The smallest distance of a group of pairs over time.

    Attributes:
        name: Name of the group.
        times: Shape (K,) [s].
        distances: Signed distances, negative for overlaps, shape (K,) [m].
        pairs: Closest pair at each time, as names of links or obstacles.
    """

    name: str
    times: Floats
    distances: Floats
    pairs: tuple[tuple[str, str], ...]

    def closest(self) -> tuple[float, float, str]:
        """Return the smallest distance [m], its time [s] and its pair as text."""
        k = int(np.argmin(self.distances))
        return float(self.distances[k]), float(self.times[k]), " – ".join(self.pairs[k])


def compute_clearance_curves(
    scene: Scene, trajectory: Trajectory, times: ArrayLike
) -> list[ClearanceCurve]:
    """Compute the smallest distances along a motion, for each kind of pair that occurs.

    The kinds are: robot and itself, robot and objects, robot and obstacles, objects and their
    surroundings, and gripper and grasped objects, which may touch.
    """
    world = World(scene)
    solids = CollisionShapes(world)
    table = PairTable(scene, solids, trajectory, 0.0)
    silent = {
        pair
        for one in find_clearance_exemptions(scene, Options().dist_safe)
        for pair in one.find_shape_pairs(world.collision_labels, world.collision_keys)
        if one.margin == -np.inf
    }
    moments = np.atleast_1d(np.asarray(times, float))
    holds = {hold for phase in trajectory.phases for hold in phase.holds} | set(scene.holds)
    gripped = {
        (link, find_grasped_link(scene, hold))
        for hold in holds
        for link in find_touch_links(scene, hold)
    }
    kinds = np.array([_find_kind(table, pair, gripped) for pair in table.pairs])
    asked = np.array([(min(pair), max(pair)) not in silent for pair in table.pairs.tolist()], bool)
    groups = {
        kind: table.pairs[(kinds == kind) & asked]
        for kind in _KINDS
        if ((kinds == kind) & asked).any()
    }
    placed = table.solids.place(world.coordinates.q(world.compute_positions(trajectory, moments)))
    curves = []
    for kind, pairs in groups.items():
        which, distances = placed.find_nearest(pairs)
        names = tuple(
            (world.collision_labels[i], world.collision_labels[j]) for i, j in pairs[which]
        )
        curves.append(ClearanceCurve(kind, moments, distances, names))
    return curves


def _find_kind(table: PairTable, pair: Ints, gripped: Set[tuple[str, str]]) -> str:
    first, second = (table.groups[int(i)] for i in pair)
    one, other = (table.world.collision_labels[int(i)] for i in pair)
    if first == "robot" and (one, other) in gripped:
        return _KINDS[4]
    if first != "robot" and second != "robot":
        return _KINDS[3]
    owner = second if first == "robot" else first
    return {"robot": _KINDS[0], "": _KINDS[2]}.get(owner, _KINDS[1])


@dataclass(frozen=True)
class _Quantity:
    """A quantity that is drawn over time, in its own column.

    Attributes:
        name: Name of the quantity.
        units: Unit of a coordinate → unit of the quantity.
        values: Function of times [s], shape (K,), that returns the drawn times, shape (L,), and
            values, shape (L, n); undefined values are NaN.
        limit: Function of a coordinate's name that returns its limit, possibly infinite.
        style: Function that returns the line style for a motion.
    """

    name: str
    units: Mapping[str, str]
    values: Callable[[CheckedMotion, Floats], tuple[Floats, Floats]]
    limit: Callable[[CheckedMotion, str], float]
    style: Callable[[Trajectory], Mapping[str, Any]]


def _find_limit(kind: str) -> Callable[[CheckedMotion, str], float]:
    """Return a function that finds a limit, "velocity" or "acceleration"; grasps have none."""

    def limit(plan: CheckedMotion, name: str) -> float:
        robot, (owner, _, joint) = plan.scene.robot, name.partition(".")
        if name in robot.coordinates.names:
            return float(getattr(robot, kind)[robot.coordinates.names.index(name)])
        placed = plan.scene.objects.get(owner)
        if placed is None or joint not in placed.object.coordinates.names:
            return float("inf")
        return float(getattr(placed.object, kind)[placed.object.coordinates.names.index(joint)])

    return limit


def _sample_accelerations(plan: CheckedMotion, times: Floats) -> tuple[Floats, Floats]:
    motion = plan.trajectory
    return (
        (times, motion.acceleration(times))
        if motion.curve is not None
        else (motion.times, motion.accelerations())
    )


_QUANTITIES: tuple[_Quantity, ...] = (
    _Quantity(
        "position",
        {"m": "m", "rad": "rad"},
        lambda plan, times: (times, plan.trajectory.at(times)),
        lambda plan, name: float("inf"),
        lambda motion: {},
    ),
    _Quantity(
        "velocity",
        {"m": "m/s", "rad": "rad/s"},
        lambda plan, times: (times, plan.trajectory.velocity(times)),
        _find_limit("velocity"),
        lambda motion: {"drawstyle": "default" if motion.curve is not None else "steps-post"},
    ),
    _Quantity(
        "acceleration",
        {"m": "m/s²", "rad": "rad/s²"},
        _sample_accelerations,
        _find_limit("acceleration"),
        lambda motion: {} if motion.curve is not None else {"marker": ".", "linestyle": "none"},
    ),
)


def _make_jerk() -> _Quantity:
    """Return the jerk, constant on each cubic of a curve; it is drawn where jerks are limited."""

    def values(plan: CheckedMotion, times: Floats) -> tuple[Floats, Floats]:
        curve = plan.trajectory.curve
        assert curve is not None
        edges = curve.acceleration(
            curve.times[:-1] + 0.5 * np.diff(curve.times)
        ) - curve.acceleration(curve.times[:-1])
        jerks = 2.0 * edges / np.diff(curve.times)[:, None]
        return curve.times, np.concatenate([jerks, jerks[-1:]])

    def limit(plan: CheckedMotion, name: str) -> float:
        return _find_limit("acceleration")(plan, name) / plan.options.jerk_time

    return _Quantity(
        "jerk",
        {"m": "m/s³", "rad": "rad/s³"},
        values,
        limit,
        lambda motion: {"drawstyle": "steps-post"},
    )


def find_groups(trajectory: Trajectory) -> dict[str, list[int]]:
    """Return the columns of a trajectory that belong to base, arm and objects."""
    names, robot = trajectory.names, trajectory.robot_size
    groups = {
        "base": list(range(3)),
        "arm": list(range(3, robot)),
        "object": list(range(robot, len(names))),
    }
    return {name: columns for name, columns in groups.items() if columns}


def draw_joints(figure: FigureBase, plan: CheckedMotion) -> None:
    """Draw all quantities, with one row each for base, arm and objects."""
    groups, motion = find_groups(plan.trajectory), plan.trajectory
    eased = motion.curve is not None and plan.options.jerk_time > 0.0
    drawn = (*_QUANTITIES, _make_jerk()) if eased else _QUANTITIES
    axes: Any = figure.subplots(len(groups), len(drawn), sharex=True, squeeze=False)
    parts = [np.linspace(motion.times[0], motion.times[-1], SAMPLES), motion.times]
    if motion.curve is not None:
        parts += [motion.curve.times, motion.curve.times[1:] - _BEFORE]
    fine = np.unique(np.concatenate(parts))
    for quantity, column in zip(drawn, axes.T, strict=True):
        moments, values = quantity.values(plan, fine)
        for place, (group, own) in zip(column, groups.items(), strict=True):
            _draw(place, plan, quantity, group, own, moments, values)
    for row in axes:
        handles = row[0].get_legend_handles_labels()[0]
        limited = [
            handle
            for place in row
            for handle in place.get_legend_handles_labels()[0]
            if handle.get_label() == "limit"
        ]
        row[-1].legend(
            handles=[*handles, *limited[:1]],
            loc="center left",
            bbox_to_anchor=(1.0, 0.5),
            fontsize=7.5,
        )
    for place in axes.ravel():
        shade_phases(place, motion)
        place.margins(x=0.0)
    for place in axes[0]:
        name_phases(place, plan)
    for place in axes[-1]:
        place.set_xlabel("time [s]")


def _draw(
    place: Axes,
    plan: CheckedMotion,
    quantity: _Quantity,
    group: str,
    columns: list[int],
    moments: Floats,
    values: Floats,
) -> None:
    """Draw a quantity of a group of coordinates, with its limits."""
    names = plan.trajectory.names
    place.set_visible(bool(np.isfinite(values[:, columns]).any()))
    for k, column in enumerate(columns):
        style = {
            "color": COLOURS[k % len(COLOURS)],
            "linewidth": 1.3,
            **quantity.style(plan.trajectory),
        }
        place.plot(moments, values[:, column], label=names[column].removesuffix("_joint"), **style)
    limits = [quantity.limit(plan, names[column]) for column in columns]
    for limit in sorted(set(filter(np.isfinite, limits))):
        same = [k for k, other in enumerate(limits) if other == limit]
        colour = COLOURS[same[0] % len(COLOURS)] if len(same) == 1 else "0.35"
        for sign in (-1.0, 1.0):
            place.axhline(sign * limit, color=colour, **DASHES)
    if any(map(np.isfinite, limits)):
        place.plot([], [], color="0.35", label="limit", **DASHES)
    own = {"base": ("m", "rad"), "arm": ("rad",), "object": ("rad", "m")}[group]
    place.set_ylabel(f"{group} {quantity.name} [{', '.join(quantity.units[unit] for unit in own)}]")


def name_phases(axes: Axes, plan: CheckedMotion) -> None:
    """Write the names of phases above the axes, alternating between two levels."""
    times = plan.trajectory.times
    for k, phase in enumerate(plan.trajectory.phases):
        middle = (times[phase.first] + times[phase.last]) / 2.0
        x = float(np.clip((middle - times[0]) / (times[-1] - times[0]), 0.12, 0.88))
        axes.text(
            x,
            1.02 + 0.09 * (k % 2),
            phase.name,
            transform=axes.transAxes,
            ha="center",
            fontsize=7.5,
            color="0.35",
        )


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
    """Plot positions, velocities and accelerations over time with their limits."""
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
