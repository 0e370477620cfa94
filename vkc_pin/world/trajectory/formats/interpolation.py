"""Interpolates the points of a trajectory as the controllers of ros2_control do.

`joint_trajectory_controller/src/trajectory.cpp` of ros2_controllers chooses a polynomial for each
segment between two points, for all joints at once: a quintic if both points have velocities and
accelerations, a cubic if both have velocities, and else a line.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.world.trajectory.curve import MIN_INTERVAL

_POSITION_ACCURACY = 1e-6  # [m] or [rad], of cubics in place of a quintic
_ACCELERATION_ACCURACY = 1e-3  # of the largest acceleration: validation accepts as much
_MAX_PIECES = 100  # of a quintic; enough for these accuracies where it covers less than 20 m
_BERNSTEIN_AT_THIRDS = np.array([[27, 0, 0, 0], [8, 12, 6, 1], [1, 6, 12, 8], [0, 0, 0, 27]]) / 27.0
_JUMP = 1e-6  # [s] in which velocities jump at the ends of lines


def interpolate_points(
    times: Floats,
    positions: Floats,
    velocities: Sequence[Floats | None],
    accelerations: Sequence[Floats | None],
) -> tuple[Floats, Floats, Floats]:
    """Return times, positions and velocities of the knots of a cubic spline.

    Lines and cubics are exact, except that velocities jump within 1 µs. Quintics are divided into
    cubics that are at most 1 µm or 1 µrad away; accelerations of a coordinate differ by at most
    1e-3 of its largest one. The robot rests before a first line, and after a last one.

    Args:
        times: Increasing times of the points, shape (K,) [s].
        positions: Positions, shape (K, n), [m] and [rad].
        velocities: Velocities of each point, shape (n,) or none.
        accelerations: Accelerations of each point, shape (n,) or none.

    Returns:
        Times (T,), positions (T, n), velocities (T, n). All points are knots.
    """
    from scipy.interpolate import BPoly

    has_velocity = np.array([row is not None for row in velocities])
    has_acceleration = np.array([row is not None for row in accelerations])
    is_line = ~(has_velocity[:-1] & has_velocity[1:])
    is_quintic = ~is_line & has_acceleration[:-1] & has_acceleration[1:]
    states = list[list[Floats]]()
    for point in zip(positions, velocities, accelerations, strict=True):
        states.append([row for row in point if row is not None])
    orders = np.where(is_line, 1, np.where(is_quintic, 5, 3))
    spline = BPoly.from_derivatives(times, states, orders=orders.tolist())
    slopes = np.diff(positions, axis=0) / np.diff(times)[:, None]
    rates = _choose_rates(slopes, velocities, is_line)
    divisions = _divide_quintics(spline, times, is_quintic)
    jumps = _place_jumps(times, slopes, rates, is_line)
    inside = np.setdiff1d(np.concatenate([divisions, jumps]), times)
    knot_times = np.concatenate([times, inside])
    knot_positions = np.concatenate([positions, spline(inside)])
    knot_velocities = np.concatenate([rates, spline.derivative()(inside)])
    order = np.argsort(knot_times)
    return knot_times[order], knot_positions[order], knot_velocities[order]


def _choose_rates(slopes: Floats, velocities: Sequence[Floats | None], is_line: Bools) -> Floats:
    """Return the velocities at all points, shape (K, n).

    A line takes no notice of the velocity of a point: between two lines, the first one ends there.
    """
    # Without a velocity, a point has that of the line before; the first and the last one rest.
    rest = np.zeros((1, slopes.shape[1]))
    rates = np.concatenate([rest, slopes])
    rates[-1] = 0.0
    for k, velocity in enumerate(velocities):
        is_between_lines = is_line[max(k - 1, 0) : k + 1].all()
        if velocity is not None and not is_between_lines:
            rates[k] = velocity
    return rates


def _place_jumps(times: Floats, slopes: Floats, rates: Floats, is_line: Bools) -> Floats:
    """Return times just after the begin and before the end of lines of another velocity [s]."""
    durations = np.diff(times)
    can_jump = is_line & (durations >= 4.0 * MIN_INTERVAL)
    delays = np.minimum(_JUMP, durations / 4.0)
    begins = can_jump & (rates[:-1] != slopes).any(axis=1)
    ends = can_jump & (rates[1:] != slopes).any(axis=1)
    return np.concatenate([(times[:-1] + delays)[begins], (times[1:] - delays)[ends]])


def _divide_quintics(spline: Any, times: Floats, is_quintic: Bools) -> Floats:
    """Return the times that divide quintics into pieces, each nearly a cubic [s]."""
    if not is_quintic.any():
        return np.empty(0)
    begins = times[:-1][is_quintic]
    durations = np.diff(times)[is_quintic]
    squares = durations[:, None] ** 2
    # A cubic that shares the positions and velocities of a function f at both ends of a time h is
    # up to h⁴/384·max |f⁗| away from it, and the second derivatives up to h²/12·max |f⁗|. Here f⁗
    # is linear, hence largest at one of its two control points.
    fourth = np.abs(spline.derivative(4).c[:, is_quintic]).max(axis=0)
    position_errors = squares**2 / 384.0 * fourth
    acceleration_errors = squares / 12.0 * fourth
    # Accelerations at the begin, after one and two thirds, and at the end.
    control = spline.derivative(2).c[:, is_quintic]
    accelerations = np.tensordot(_BERNSTEIN_AT_THIRDS, control, axes=1)
    largest = np.abs(accelerations).max(axis=(0, 1))
    accepted = np.maximum(_ACCELERATION_ACCURACY * largest, np.finfo(float).tiny)
    # With n pieces, the errors are divided by n⁴ and by n².
    counts_for_positions = (position_errors / _POSITION_ACCURACY) ** 0.25
    counts_for_accelerations = np.sqrt(acceleration_errors / accepted)
    counts = np.maximum(counts_for_positions, counts_for_accelerations)
    pieces = np.clip(np.ceil(counts.max(axis=1)), 1, _MAX_PIECES).astype(int)
    divisions = [times[:0]]
    for begin, duration, count in zip(begins, durations, pieces, strict=True):
        if duration >= 2.0 * count * MIN_INTERVAL:
            divisions.append(begin + duration * np.arange(1, count) / count)
    return np.concatenate(divisions)
