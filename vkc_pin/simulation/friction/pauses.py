"""Pauses of a motion in which a hand closes or opens: plans have none, fingers need time."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["paused"]

_REST = 1e-6  # [m/s] or [rad/s] at which all stands still


def paused(trajectory: Trajectory, waypoints: Iterable[int], seconds: float) -> Trajectory:
    """Return a motion that stands still for a while at some waypoints; each becomes two, both of the phase that begins there.

    Args:
        trajectory: The motion.
        waypoints: Where, none of them the last one.
        seconds: For how long [s].

    Raises:
        InputError: The motion, a curve, is not at rest at one of them.
    """
    at = np.array(sorted(set(waypoints)), int)
    if not len(at):
        return trajectory
    curve = trajectory.curve
    if curve is not None:
        knots = np.searchsorted(curve.times, trajectory.times[at])
        moving = np.abs(curve.rates[knots]).max(axis=1) > _REST
        if moving.any():
            got = f"moving at {trajectory.times[at[moving]][0]:.2f} s"
            raise InputError(
                "the hand closes or opens while the robot moves",
                field="trajectory",
                expected="a rest",
                got=got,
            )
        rates = np.insert(curve.rates, knots + 1, 0.0, axis=0)
        rates[knots + np.arange(len(knots))] = 0.0
        positions = np.insert(curve.positions, knots + 1, curve.positions[knots], axis=0)
        curve = Curve(_later(curve.times, knots, seconds), positions, rates)

    def moved(waypoint: int) -> int:
        return waypoint + int(np.searchsorted(at, waypoint))

    return replace(
        trajectory,
        times=_later(trajectory.times, at, seconds),
        positions=np.insert(trajectory.positions, at + 1, trajectory.positions[at], axis=0),
        phases=tuple(
            replace(phase, first=moved(phase.first), last=moved(phase.last))
            for phase in trajectory.phases
        ),
        curve=curve,
    )


def _later(times: Floats, at: Ints, seconds: float) -> Floats:
    """Return times of which some are there twice, `seconds` apart; what comes after is later by as much."""
    delays = seconds * np.searchsorted(at, np.arange(len(times)))
    return np.asarray(np.insert(times + delays, at + 1, (times + delays)[at] + seconds))
