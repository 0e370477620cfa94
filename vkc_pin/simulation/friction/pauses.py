"""Inserts pauses into a trajectory in which the hand closes or opens."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["insert_pauses"]

_REST = 1e-6  # [m/s] or [rad/s] up to which the robot is at rest


def insert_pauses(trajectory: Trajectory, waypoints: Iterable[int], seconds: float) -> Trajectory:
    """Insert a pause at some waypoints.

    Each of these waypoints is duplicated; both copies belong to the phase that begins there.

    Args:
        trajectory: The trajectory.
        waypoints: Waypoints at which to pause, none of them the last one.
        seconds: Duration of each pause [s].

    Raises:
        InputError: The trajectory's curve is not at rest at one of the waypoints.
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
                expected="a trajectory at rest",
                got=got,
            )
        rates = np.insert(curve.rates, knots + 1, 0.0, axis=0)
        rates[knots + np.arange(len(knots))] = 0.0
        positions = np.insert(curve.positions, knots + 1, curve.positions[knots], axis=0)
        curve = Curve(_insert_delays(curve.times, knots, seconds), positions, rates)

    def shift_index(waypoint: int) -> int:
        return waypoint + int(np.searchsorted(at, waypoint))

    return replace(
        trajectory,
        times=_insert_delays(trajectory.times, at, seconds),
        positions=np.insert(trajectory.positions, at + 1, trajectory.positions[at], axis=0),
        phases=tuple(
            replace(phase, first=shift_index(phase.first), last=shift_index(phase.last))
            for phase in trajectory.phases
        ),
        curve=curve,
    )


def _insert_delays(times: Floats, at: Ints, seconds: float) -> Floats:
    """Return times with those at indices `at` doubled, `seconds` apart, and later ones delayed."""
    delays = seconds * np.searchsorted(at, np.arange(len(times)))
    return np.asarray(np.insert(times + delays, at + 1, (times + delays)[at] + seconds))
