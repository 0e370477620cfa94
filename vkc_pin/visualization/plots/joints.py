"""Plots positions, velocities, accelerations and jerks over time, with their limits."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vkc_pin.utils.arrays import Floats
from vkc_pin.validation.report import CheckedMotion
from vkc_pin.visualization.plots.style import COLOURS, shade_phases
from vkc_pin.world.trajectory.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

__all__ = ["DASHES", "SAMPLES", "draw_joints", "find_groups", "name_phases"]

SAMPLES = 240
"""Number of times at which a motion is drawn, besides its waypoints and knots."""
_BEFORE = 1e-9  # offset before a knot, where accelerations jump [s]
DASHES: Any = {"linestyle": (0, (5, 3)), "linewidth": 0.9}
"""Style of limits."""


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
