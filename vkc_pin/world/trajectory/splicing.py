"""Concatenates motions and extracts parts of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.trajectory.curve import MIN_INTERVAL, Curve
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory

_SHORTEST = 10.0 * MIN_INTERVAL  # [s] between two knots
MAX_GAP = 1e-6  # [m], [rad] between the end of a motion and the begin of the next


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
    waypoints = _Rows(names)
    knots = _Rows(names)
    phases = list[PhaseSpan]()
    for number, (part, curve) in enumerate(zip(parts, curves, strict=True)):
        shift = 0  # index of the motion's first waypoint in the whole one
        rest = 0.0
        if number:
            distances = np.abs(part.positions[0, :robot] - waypoints.last(part.names[:robot]))
            largest = distances.max()
            if not largest <= MAX_GAP:
                problem = "a motion does not begin where the one before it ends"
                got = f"{largest:g} apart"
                raise InputError(problem, field=f"parts[{number}]", got=got)
            shift = len(waypoints.times) - 1
            if pause > 0.0 and _changes_grasp(phases[-1], part.phases[0]):
                # The rest has a segment of its own.
                shift += 1
                rest = pause
        waypoints.add(part.names, part.times, part.positions, rest)
        if curve is not None:
            knots.add(part.names, curve.times, curve.positions, rest, curve.rates)
        for k, phase in enumerate(part.phases):
            first = phase.first + shift
            if k == 0:
                # The rest belongs to the phase after it.
                first = phases[-1].last if phases else 0
            phases.append(replace(phase, first=first, last=phase.last + shift))
    whole = None
    if all(curve is not None for curve in curves):
        whole = Curve(np.array(knots.times), knots.fill(), np.array(knots.rates))
    times = np.array(waypoints.times)
    return Trajectory(tuple(names), times, waypoints.fill(), tuple(phases), robot, whole)


def _changes_grasp(before: PhaseSpan, after: PhaseSpan) -> bool:
    """Return whether holds or the gripper opening change between two phases."""
    return set(before.holds) != set(after.holds) or before.opening != after.opening


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
        all_positions = np.full(shape, np.nan)
        all_positions[:, columns] = positions
        all_rates = np.zeros(shape)
        if rates is not None:
            all_rates[:, columns] = rates
        shifted_times = begin + (times - times[0])
        self.rows += list(all_positions[skipped:])
        self.rates += list(all_rates[skipped:])
        self.times += shifted_times[skipped:].tolist()

    def last(self, names: Sequence[str]) -> Floats:
        """Return the last values of coordinates."""
        columns = [self.names.index(name) for name in names]
        return np.asarray(self.rows[-1][columns])

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


def extract_times(trajectory: Trajectory, begin: float, end: float) -> Trajectory:
    """Extract the part of a motion between two different times [s] inside it.

    Phases without duration in between are left out. The times of the part are the original ones.
    """
    times = _cut(trajectory.times, begin, end)
    spans = list[PhaseSpan]()
    for phase in trajectory.phases:
        first, last = np.clip(trajectory.times[[phase.first, phase.last]], begin, end)
        rows = np.searchsorted(times, [first - _SHORTEST, last - _SHORTEST]).tolist()
        if rows[1] > rows[0]:
            spans.append(replace(phase, first=rows[0], last=rows[1]))
    curve = trajectory.curve
    positions = trajectory.at(times)
    if curve is not None:
        # A part of a cubic is the cubic with the same positions and velocities at its ends.
        knots = _cut(curve.times, begin, end)
        curve = Curve(knots, curve.at(knots), curve.velocity(knots))
        positions = curve.positions[np.searchsorted(knots, times)]
    names = trajectory.names
    return Trajectory(names, times, positions, tuple(spans), trajectory.robot_size, curve)


def _cut(times: Floats, begin: float, end: float) -> Floats:
    """Return times between two others, with these, without those that are too near to them."""
    inside = times[(times > begin + _SHORTEST) & (times < end - _SHORTEST)]
    return np.concatenate([[begin], inside, [end]])


def extract_phases(
    trajectory: Trajectory, names: Sequence[str], begin: int, end: int | None
) -> Trajectory:
    """Extract phases and coordinates of a motion."""
    phases = trajectory.phases[begin:end]
    first = phases[0].first
    last = phases[-1].last
    spans = list[PhaseSpan]()
    for phase in phases:
        spans.append(replace(phase, first=phase.first - first, last=phase.last - first))
    waypoints = slice(first, last + 1)
    columns = [trajectory.names.index(name) for name in names]
    times = trajectory.times[waypoints]
    positions = trajectory.positions[waypoints][:, columns]
    curve = trajectory.curve
    if curve is not None:
        curve = curve.part(times[0], times[-1], columns)
    return Trajectory(tuple(names), times, positions, tuple(spans), trajectory.robot_size, curve)
