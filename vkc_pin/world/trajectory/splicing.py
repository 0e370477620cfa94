"""Concatenates motions and extracts parts of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory


def concatenate_trajectories(parts: Sequence[Trajectory], *, pause: float) -> Trajectory:
    """Concatenate motions, with pauses [s] where holds or the gripper opening change.

    Missing coordinates keep their last known value, or have the next one. Raises `InputError` if a
    motion begins more than 1e-6 [m], [rad] from the end of its predecessor.
    """
    if not parts:
        expected = "at least one trajectory"
        raise InputError("nothing to concatenate", field="parts", expected=expected)
    robot = parts[0].robot_size
    names = list(dict.fromkeys(name for part in parts for name in part.names))
    curves = [_get_curve(part) for part in parts]
    waypoints, knots, phases = _Rows(names), _Rows(names), list[PhaseSpan]()
    for number, (part, curve) in enumerate(zip(parts, curves, strict=True)):
        shift = waits = 0
        if number:
            apart = np.abs(part.positions[0, :robot] - waypoints.last(part.names[:robot])).max()
            if not apart <= 1e-6:
                problem = "a motion does not begin where the one before it ends"
                got = f"{apart:g} apart"
                raise InputError(problem, field=f"parts[{number}]", got=got)
            before, after = phases[-1], part.phases[0]
            waits = set(before.holds) != set(after.holds) or before.opening != after.opening
            shift = len(waypoints.times) - 1 + waits
        rest = pause if waits else 0.0
        waypoints.add(part.names, part.times, part.positions, rest)
        if curve is not None:
            knots.add(part.names, curve.times, curve.positions, rest, curve.rates)
        for k, phase in enumerate(part.phases):
            first = phases[-1].last if phases else 0
            first = phase.first + shift if k else first
            phases.append(replace(phase, first=first, last=phase.last + shift))
    whole = None
    if all(curve is not None for curve in curves):
        whole = Curve(np.array(knots.times), knots.fill(), np.array(knots.rates))
    times = np.array(waypoints.times)
    return Trajectory(tuple(names), times, waypoints.fill(), tuple(phases), robot, whole)


class _Rows:
    """Accumulates rows of several motions."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names = list(names)
        self.times: list[float] = []
        self.rows: list[Floats] = []
        self.rates: list[Floats] = []

    def add(
        self,
        names: Sequence[str],
        times: Floats,
        positions: Floats,
        rest: float,
        rates: Floats | None = None,
    ) -> None:
        """Append rows after a rest [s]; without a rest, the first row repeats the last one."""
        columns = [self.names.index(name) for name in names]
        begin = self.times[-1] + rest if self.times else 0.0
        skipped = 1 if self.times and not rest else 0
        shape = (len(times), len(self.names))
        values, slopes = np.full(shape, np.nan), np.zeros(shape)
        values[:, columns] = positions
        slopes[:, columns] = 0.0 if rates is None else rates
        moments = begin + (times - times[0])
        self.rows += list(values[skipped:])
        self.rates += list(slopes[skipped:])
        self.times += moments[skipped:].tolist()

    def last(self, names: Sequence[str]) -> Floats:
        """Return the last values of coordinates."""
        return np.asarray(self.rows[-1][[self.names.index(name) for name in names]])

    def fill(self) -> Floats:
        return fill_missing_values(np.array(self.rows))


def _get_curve(part: Trajectory) -> Curve | None:
    """Return a motion's curve, a constant one for a motion at rest, or None."""
    if part.curve is None and not np.ptp(part.positions, axis=0).any():
        return Curve(part.times, part.positions, np.zeros_like(part.positions))
    return part.curve


def fill_missing_values(table: Floats) -> Floats:
    """Replace NaN in waypoints, shape (T, n), by the last known value, or else the next one.

    Coordinates without any known value keep NaN.
    """
    table = table.copy()
    for column in table.T:
        known = np.flatnonzero(~np.isnan(column))
        if len(known):
            last = np.searchsorted(known, np.arange(len(column)), side="right") - 1
            column[:] = column[known[np.maximum(last, 0)]]
    return table


def extract_phases(
    trajectory: Trajectory, names: Sequence[str], begin: int, end: int | None
) -> Trajectory:
    """Extract phases and coordinates of a motion."""
    phases = trajectory.phases[begin:end]
    first, last = phases[0].first, phases[-1].last
    columns = [trajectory.names.index(name) for name in names]
    spans = tuple(
        replace(phase, first=phase.first - first, last=phase.last - first) for phase in phases
    )
    rows, curve = slice(first, last + 1), trajectory.curve
    times, positions = trajectory.times[rows], trajectory.positions[rows][:, columns]
    if curve is not None:
        curve = curve.part(times[0], times[-1], columns)
    return Trajectory(tuple(names), times, positions, spans, trajectory.robot_size, curve)
