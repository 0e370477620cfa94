"""Motions put together, and parts of them taken out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vkc_pin.arrays import Floats
from vkc_pin.errors import InputError
from vkc_pin.motion.trajectory import PhaseSpan, Trajectory

__all__ = ["cut", "filled", "join"]


def join(parts: Sequence[Trajectory], *, pause: float) -> Trajectory:
    """Return motions one after the other as one.

    Args:
        parts: Each begins where the one before it ends. A coordinate that a part does not have keeps its value there.
        pause: How long the robot waits between two parts where the hand closes or opens [s].

    Raises:
        InputError: There is none, or one does not begin where the one before it ends.
    """
    if not parts:
        raise InputError("nothing to join", field="parts", expected="at least one trajectory")
    robot = parts[0].robot_size
    names = list(dict.fromkeys(name for part in parts for name in part.names))
    rows: list[Floats] = []
    times: list[float] = []
    phases: list[PhaseSpan] = []
    for number, part in enumerate(parts):
        values = np.full((len(part.times), len(names)), np.nan)
        values[:, [names.index(name) for name in part.names]] = part.positions
        start, shift = 0.0 if not times else times[-1], 0
        if number:
            apart = np.abs(values[0, :robot] - rows[-1][:robot]).max()
            if not apart <= 1e-6:
                where = f"parts[{number}]"
                raise InputError("a motion does not begin where the one before it ends", field=where, got=f"{apart:g} apart")
            before, after = phases[-1], part.phases[0]
            shift = len(rows) - 1
            if set(before.holds) != set(after.holds) or before.opening != after.opening:
                rows.append(values[0])
                times.append(start + pause)
                start, shift = start + pause, shift + 1
        rows += list(values[1:] if number else values)
        times += (start + (part.times[1:] if number else part.times) - part.times[0]).tolist()
        for k, phase in enumerate(part.phases):
            first = phases[-1].last if phases else 0
            phases.append(replace(phase, first=first if k == 0 else phase.first + shift, last=phase.last + shift))
    return Trajectory(tuple(names), np.array(times), filled(np.array(rows)), tuple(phases), robot)


def filled(table: Floats) -> Floats:
    """Return waypoints, shape (T, n), with what is not known (NaN) as it was last, or else as it will be next.

    A coordinate that is known nowhere stays so.
    """
    table = table.copy()
    for column in table.T:
        known = np.flatnonzero(~np.isnan(column))
        if len(known):
            column[:] = column[known[np.maximum(np.searchsorted(known, np.arange(len(column)), side="right") - 1, 0)]]
    return table


def cut(trajectory: Trajectory, names: Sequence[str], begin: int, end: int | None) -> Trajectory:
    """Return a part of a motion, of some of its coordinates.

    Args:
        trajectory: The motion.
        names: Of the coordinates, in the order wanted.
        begin: The part's first phase.
        end: The phase before which it ends; None: with the motion.
    """
    phases = trajectory.phases[begin:end]
    first, last = phases[0].first, phases[-1].last
    columns = [trajectory.names.index(name) for name in names]
    spans = tuple(replace(phase, first=phase.first - first, last=phase.last - first) for phase in phases)
    rows = slice(first, last + 1)
    return Trajectory(tuple(names), trajectory.times[rows], trajectory.positions[rows][:, columns], spans, trajectory.robot_size)
