"""Plots joints and clearance over time, and the top view of a motion, with matplotlib.

Figures are made without pyplot: they need no screen, and none stays open.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
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


_MAY_TOUCH = "gripper – grasped object"
_KINDS = (
    "robot – itself",
    "robot – objects",
    "robot – obstacles",
    "objects – surroundings",
    _MAY_TOUCH,
)
SAMPLES = 240
"""Number of times at which a motion is drawn, besides its waypoints and knots."""
# [s] offset before a knot, where accelerations jump
_BEFORE = 1e-9
DASHES: Any = {"linestyle": (0, (5, 3)), "linewidth": 0.9}
"""Style of limits."""
PICTURES = (".png", ".svg", ".pdf")
"""File name extensions of pictures."""
# [m] larger clearances are cut off
_SHOWN = 0.30


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
    labels = world.collision_labels
    table = PairTable(scene, CollisionShapes(world), trajectory, 0.0)
    unchecked = _find_unchecked_pairs(world)
    gripped = _find_gripped_links(scene, trajectory)
    kinds = np.array([_find_kind(table, pair, gripped) for pair in table.pairs])
    is_checked = np.array(
        [(min(pair), max(pair)) not in unchecked for pair in table.pairs.tolist()], bool
    )
    moments = np.atleast_1d(np.asarray(times, float))
    z = world.compute_positions(trajectory, moments)
    placed = table.solids.place(world.coordinates.q(z))
    curves: list[ClearanceCurve] = []
    for kind in _KINDS:
        pairs = table.pairs[(kinds == kind) & is_checked]
        if not len(pairs):
            continue
        nearest, distances = placed.find_nearest(pairs)
        names = [(labels[i], labels[j]) for i, j in pairs[nearest]]
        curves.append(ClearanceCurve(kind, moments, distances, tuple(names)))
    return curves


def _find_unchecked_pairs(world: World) -> set[tuple[int, int]]:
    """Return the pairs of shapes whose distance the scene does not limit, the smaller first."""
    pairs = set[tuple[int, int]]()
    for exemption in find_clearance_exemptions(world.scene, Options().dist_safe):
        if exemption.margin == -np.inf:
            pairs.update(exemption.find_shape_pairs(world.collision_labels, world.collision_keys))
    return pairs


def _find_gripped_links(scene: Scene, trajectory: Trajectory) -> set[tuple[str, str]]:
    """Return the pairs of a holder's link and the link that it grasps, at any time."""
    holds = set(scene.holds)
    for phase in trajectory.phases:
        holds.update(phase.holds)
    gripped = set[tuple[str, str]]()
    for hold in holds:
        grasped = find_grasped_link(scene, hold)
        gripped.update((link, grasped) for link in find_touch_links(scene, hold))
    return gripped


def _find_kind(table: PairTable, pair: Ints, gripped: Set[tuple[str, str]]) -> str:
    """Return the kind of a pair of shapes."""
    i, j = pair.tolist()
    first = table.groups[i]
    second = table.groups[j]
    labels = table.world.collision_labels
    if first == "robot" and (labels[i], labels[j]) in gripped:
        return _KINDS[4]
    if first != "robot" and second != "robot":
        return _KINDS[3]
    other = second if first == "robot" else first
    if other == "robot":
        return _KINDS[0]
    return _KINDS[1] if other else _KINDS[2]


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
        robot = plan.scene.robot
        if name in robot.coordinates.names:
            return float(getattr(robot, kind)[robot.coordinates.names.index(name)])
        owner, _, joint = name.partition(".")
        placed = plan.scene.objects.get(owner)
        if placed is None or joint not in placed.object.coordinates.names:
            return float("inf")
        return float(getattr(placed.object, kind)[placed.object.coordinates.names.index(joint)])

    return limit


def _sample_accelerations(plan: CheckedMotion, times: Floats) -> tuple[Floats, Floats]:
    """Return times and accelerations; without a curve those at waypoints."""
    motion = plan.trajectory
    if motion.curve is None:
        return motion.times, motion.accelerations()
    return times, motion.acceleration(times)


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
        begins = curve.times[:-1]
        spans = np.diff(curve.times)
        # Accelerations are linear on each cubic, and may jump at its ends.
        changes = curve.acceleration(begins + 0.5 * spans) - curve.acceleration(begins)
        jerks = 2.0 * changes / spans[:, None]
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
    size = trajectory.robot_size
    groups = {
        "base": list(range(3)),
        "arm": list(range(3, size)),
        "object": list(range(size, len(trajectory.names))),
    }
    return {name: columns for name, columns in groups.items() if columns}


def draw_joints(figure: FigureBase, plan: CheckedMotion) -> None:
    """Draw all quantities, with one row each for base, arm and objects."""
    motion = plan.trajectory
    groups = find_groups(motion)
    has_jerk_limits = motion.curve is not None and plan.options.jerk_time > 0.0
    quantities = (*_QUANTITIES, _make_jerk()) if has_jerk_limits else _QUANTITIES
    grid: Any = figure.subplots(len(groups), len(quantities), sharex=True, squeeze=False)
    parts = [np.linspace(motion.times[0], motion.times[-1], SAMPLES), motion.times]
    if motion.curve is not None:
        parts += [motion.curve.times, motion.curve.times[1:] - _BEFORE]
    times = np.unique(np.concatenate(parts))
    for quantity, column in zip(quantities, grid.T, strict=True):
        moments, values = quantity.values(plan, times)
        for axes, (group, own) in zip(column, groups.items(), strict=True):
            _draw(axes, plan, quantity, group, own, moments, values)
    for row in grid:
        _add_legend(row)
    for axes in grid.ravel():
        shade_phases(axes, motion)
        axes.margins(x=0.0)
    for axes in grid[0]:
        name_phases(axes, plan)
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")


def _add_legend(row: Sequence[Axes]) -> None:
    """Add a legend beside a row of axes: the lines of the first ones, and one limit."""
    handles, _ = row[0].get_legend_handles_labels()
    limits: list[Any] = []
    for axes in row:
        for handle in axes.get_legend_handles_labels()[0]:
            if handle.get_label() == "limit":
                limits.append(handle)
    row[-1].legend(
        handles=[*handles, *limits[:1]],
        loc="center left",
        bbox_to_anchor=(1.0, 0.5),
        fontsize=7.5,
    )


def _draw(
    axes: Axes,
    plan: CheckedMotion,
    quantity: _Quantity,
    group: str,
    columns: list[int],
    moments: Floats,
    values: Floats,
) -> None:
    """Draw a quantity of a group of coordinates, with its limits."""
    names = plan.trajectory.names
    axes.set_visible(bool(np.isfinite(values[:, columns]).any()))
    for k, column in enumerate(columns):
        style = {
            "color": COLOURS[k % len(COLOURS)],
            "linewidth": 1.3,
            **quantity.style(plan.trajectory),
        }
        label = names[column].removesuffix("_joint")
        axes.plot(moments, values[:, column], label=label, **style)
    limits = [quantity.limit(plan, names[column]) for column in columns]
    finite = {limit for limit in limits if np.isfinite(limit)}
    for limit in sorted(finite):
        same = [k for k, other in enumerate(limits) if other == limit]
        colour = COLOURS[same[0] % len(COLOURS)] if len(same) == 1 else "0.35"
        axes.axhline(-limit, color=colour, **DASHES)
        axes.axhline(limit, color=colour, **DASHES)
    if finite:
        axes.plot([], [], color="0.35", label="limit", **DASHES)
    own = {"base": ("m", "rad"), "arm": ("rad",), "object": ("rad", "m")}[group]
    units = ", ".join(quantity.units[unit] for unit in own)
    axes.set_ylabel(f"{group} {quantity.name} [{units}]")


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
    width = 9.0
    height = float(np.clip(width * (y_max - y_min) / (x_max - x_min) + 0.7, 4.0, 10.0))
    with use_style():
        figure = new_figure(width, height)
        draw_top_view(figure, World(plan.scene), plan.trajectory)
    return figure


def _check_plan(plan: CheckedMotion) -> None:
    if not isinstance(plan, CheckedMotion):
        raise InputError(
            "cannot be plotted", field="plan", expected="a Plan", got=type(plan).__name__
        )


def _plot_all(plan: CheckedMotion) -> Figure:
    """Plot everything in one figure."""
    outcome = "success" if plan.success else f"FAILED, {plan.status}"
    with use_style():
        figure = new_figure(16.0, 11.0)
        parts: Any = figure.subfigures(2, 1, height_ratios=(1.15, 1.0))
        upper, lower = parts
        draw_joints(upper, plan)
        left, right = lower.subfigures(1, 2, width_ratios=(1.0, 1.25))
        _draw_clearance(left, plan)
        draw_top_view(right, World(plan.scene), plan.trajectory)
        figure.suptitle(f"{plan.scene.name}: {outcome}", fontweight="bold")
    return figure


def _draw_clearance(figure: FigureBase, plan: CheckedMotion) -> None:
    """Draw the smallest distances over time; the legend names the closest pairs."""
    axes = figure.subplots()
    trajectory = plan.trajectory
    even = np.linspace(trajectory.times[0], trajectory.times[-1], SAMPLES)
    times = np.unique(np.concatenate([even, trajectory.times]))
    safe = plan.options.dist_safe
    lowest = 0.0
    for k, curve in enumerate(compute_clearance_curves(plan.scene, trajectory, times)):
        distance, when, pair = curve.closest()
        may_touch = curve.name == _MAY_TOUCH
        colour = "0.6" if may_touch else COLOURS[k % len(COLOURS)]
        label = f"{curve.name}: {1e3 * distance:.0f} mm, {pair}, {when:.1f} s"
        style: Any = {"linestyle": ":" if may_touch else "-", "linewidth": 1.5, "label": label}
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
