"""Makes curves that brake from a velocity to rest, and that accelerate from rest to one."""

from __future__ import annotations

import numpy as np

from vkc_pin.planning.retiming.limits import Limits
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.wheels import RollingLimits, rotate_into_base_frame

_LONGER = 1.1  # factor of the duration of an arc whose accelerations exceed their limits
_MAX_LONGER = 20  # times that it is applied
_CUBICS_OF_ARC = 16  # so that cubics between their ends roll, too
_MIN_DURATION = 1e-3  # [s]
_ROUNDING = 1e-8  # relative


def make_braking_curve(
    position: Floats, velocity: Floats, limits: Limits, rolling: RollingLimits
) -> Curve:
    """Return the fastest curve that brakes from a velocity to rest and keeps its direction.

    At the fraction s of the duration T the velocity is g(s)·v. Without jerk limits it falls
    linearly. With them the acceleration grows and falls linearly,

        g(s) = 1 − 2s² for s ≤ 1/2, otherwise 2(1 − s)²

    so that it is at most 2v/T, and the jerk 4v/T². Both cover the distance v·T/2. A base on wheels
    follows the arc of its velocity.

    Args:
        position: Coordinates, shape (n,).
        velocity: Velocity v, shape (n,).
        limits: Limits of the coordinates.
        rolling: Limits of the base.
    """
    speeds = np.abs(velocity)
    if limits.has_unlimited_jerk:
        duration = float((speeds / limits.acceleration).max())
        fractions = np.array([0.0, 1.0])
    else:
        for_acceleration = float((2.0 * speeds / limits.acceleration).max())
        for_jerk = float(np.sqrt((4.0 * speeds / limits.jerk).max()))
        duration = max(for_acceleration, for_jerk)
        fractions = np.array([0.0, 0.5, 1.0])
    duration = max(duration, _MIN_DURATION)
    shares, distances = _evaluate_profile(fractions, smooth=not limits.has_unlimited_jerk)
    if rolling.is_omnidirectional:
        times = duration * fractions
        positions = position + np.outer(duration * distances, velocity)
        return Curve(times, positions, np.outer(shares, velocity))
    curve = _brake_along_arc(position, velocity, duration, limits)
    for _ in range(_MAX_LONGER):
        if limits.compute_slowdown(curve) <= 1.0 + _ROUNDING:
            break
        duration *= _LONGER
        curve = _brake_along_arc(position, velocity, duration, limits)
    return curve


def make_accelerating_curve(
    position: Floats, velocity: Floats, limits: Limits, rolling: RollingLimits
) -> Curve:
    """Return the fastest curve from rest that ends at a position with a velocity, shape (n,) each.

    It is the reversed `make_braking_curve` of the opposite velocity.
    """
    curve = make_braking_curve(position, -velocity, limits, rolling)
    times = curve.times[-1] - curve.times[::-1]
    return Curve(times, curve.positions[::-1], -curve.rates[::-1])


def _evaluate_profile(fractions: Floats, *, smooth: bool) -> tuple[Floats, Floats]:
    """Return g and its integral from 0 at fractions of the duration; see `make_braking_curve`."""
    s = fractions
    if not smooth:
        return 1.0 - s, s - 0.5 * s**2
    r = 1.0 - s
    is_first_half = s <= 0.5
    shares = np.where(is_first_half, 1.0 - 2.0 * s**2, 2.0 * r**2)
    distances = np.where(is_first_half, s - 2.0 / 3.0 * s**3, 0.5 - 2.0 / 3.0 * r**3)
    return shares, distances


def _brake_along_arc(position: Floats, velocity: Floats, duration: float, limits: Limits) -> Curve:
    """Return a curve of `make_braking_curve` for a base on wheels."""
    fractions = np.linspace(0.0, 1.0, _CUBICS_OF_ARC + 1)
    shares, distances = _evaluate_profile(fractions, smooth=not limits.has_unlimited_jerk)
    positions = position + np.outer(duration * distances, velocity)
    rates = np.outer(shares, velocity)
    vx, vy = velocity[:2, None]
    along, _ = rotate_into_base_frame(vx, vy, position[2:3])
    # The chord of an arc is parallel to its mean heading, and shorter by sin(δθ/2) / (δθ/2).
    turns = positions[:, 2] - position[2]
    chords = along * duration * distances * np.sinc(turns / (2.0 * np.pi))
    mean_headings = position[2] + turns / 2.0
    positions[:, 0] = position[0] + chords * np.cos(mean_headings)
    positions[:, 1] = position[1] + chords * np.sin(mean_headings)
    rates[:, 0] = along * shares * np.cos(positions[:, 2])
    rates[:, 1] = along * shares * np.sin(positions[:, 2])
    return Curve(duration * fractions, positions, rates)
