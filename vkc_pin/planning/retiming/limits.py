"""Holds the rate limits of coordinates, and slows motions down to keep them and jerk limits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vkc_pin.planning.retiming.cubic_path import CubicPath
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.articulated_object import ArticulatedObject
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.curve import Curve, sample_intervals
from vkc_pin.world.trajectory.wheels import RollingLimits

_ROUNDING = 1e-9  # relative
# averaging intervals, as multiples of the time in which an acceleration may build up
_SPAN_FACTORS = np.geomspace(0.25, 4.0, 9)
_MIN_CUBICS_PER_STEP = 4
_MAX_CUBIC_DURATION = 0.5  # relative to the averaging interval
_SAMPLES_PER_CUBIC = 8  # to bracket the time of a waypoint
_NEWTON_ITERATIONS = 6


class Limits(NamedTuple):
    """Limits of coordinates, shape (n,) each, SI units."""

    lower: Floats
    upper: Floats
    velocity: Floats
    acceleration: Floats
    jerk: Floats

    @classmethod
    def from_scene(cls, scene: Scene, names: Sequence[str], jerk_time: float) -> Limits:
        """Return the limits (eqs. 4 and 5) of coordinates; freedoms of grasps have none.

        Args:
            scene: Robot and objects.
            names: Coordinate names of the robot, and "<object>.<joint>".
            jerk_time: See `Options.jerk_time`.
        """
        limits_by_name = dict[str, tuple[float, ...]]()
        owners: list[tuple[str, Robot | ArticulatedObject]] = [("", scene.robot)]
        owners += [(f"{name}.", placed.object) for name, placed in scene.objects.items()]
        for prefix, owner in owners:
            sides = (owner.lower, owner.upper, owner.velocity, owner.acceleration)
            rows = map(tuple, np.transpose(sides).tolist())
            names_of_owner = (prefix + name for name in owner.coordinates.names)
            limits_by_name |= zip(names_of_owner, rows, strict=True)
        unlimited = (-np.inf, np.inf, np.inf, np.inf)
        rows_of_names = np.array([limits_by_name.get(name, unlimited) for name in names])
        lower, upper, velocity, acceleration = rows_of_names.T
        jerk = acceleration / jerk_time if jerk_time > 0.0 else np.full(len(names), np.inf)
        return cls(lower, upper, velocity, acceleration, jerk)

    def with_wheels(self, rolling: RollingLimits) -> Limits:
        """Return the limits with those of the left and right wheel appended.

        The wheels' acceleration is limited only by that of the base.
        """
        acceleration = self.acceleration[:2].sum() + rolling.track / 2 * self.acceleration[2]
        wheel = (-np.inf, np.inf, rolling.wheel_speed, acceleration, np.inf)
        return Limits(
            *(np.append(side, [value, value]) for side, value in zip(self, wheel, strict=True))
        )

    @property
    def has_unlimited_jerk(self) -> bool:
        """Whether the jerk of no coordinate is limited."""
        return not np.isfinite(self.jerk).any()

    def compute_slowdown(self, curve: Curve) -> float:
        """Return the factor, at least 1, by which a curve must be slowed to keep its limits."""
        speeds, accelerations = curve.compute_max_rates()
        factors = [
            1.0,
            float((speeds / self.velocity).max()),
            float(np.sqrt((accelerations / self.acceleration).max())),
        ]
        if not self.has_unlimited_jerk:
            factors.append(float(np.cbrt((curve.compute_jerks()[0] / self.jerk).max())))
        return max(factors) * (1.0 + _ROUNDING)

    def slow_down(self, curve: Curve) -> Curve:
        """Return a curve, slowed down as much as its rate limits require."""
        factor = self.compute_slowdown(curve)
        return Curve(curve.times * factor, curve.positions, curve.rates / factor)


def limit_jerk(path: CubicPath, pace: Curve, steps: int, limits: Limits) -> Curve:
    """Return a curve along a path with limited jerk, and zero acceleration at both ends.

    The progress along the path is replaced by its moving average, which is smoother by one order.
    Twice differentiable cubics interpolate the path; they are slowed down until all limits are
    kept. The fastest result of several averaging intervals is returned.

    Args:
        path: The path, with the same number of knots in every step.
        pace: Progress along the path over time, one coordinate, from rest to rest, from 0 at 0 s.
        steps: Number of steps.
        limits: Limits of the path's coordinates.
    """
    limited = np.isfinite(limits.jerk)
    rise_time = float((limits.acceleration[limited] / limits.jerk[limited]).max())
    candidates = (
        limits.slow_down(_average_pace(path, pace, steps, factor * rise_time))
        for factor in _SPAN_FACTORS
    )
    return min(candidates, key=lambda curve: float(curve.times[-1]))


def _average_pace(path: CubicPath, pace: Curve, steps: int, span: float) -> Curve:
    """Return the curve for an averaging interval `span` [s], before it is slowed down."""
    from scipy.interpolate import CubicHermiteSpline as Hermite
    from scipy.interpolate import make_interp_spline

    progress = Hermite(pace.times, pace.positions[:, 0], pace.rates[:, 0])
    area, last, length = progress.antiderivative(), pace.times[-1], pace.positions[-1, 0]

    def compute_progress(times: Floats) -> Floats:
        now, before = (
            area(np.clip(t, 0.0, last)) + length * np.maximum(t - last, 0.0)
            for t in (times, times - span)
        )
        return np.asarray((now - before) / span)

    def compute_speed(times: Floats) -> Floats:
        now, before = (progress(np.clip(t, 0.0, last)) for t in (times, times - span))
        return np.asarray((now - before) / span)

    waypoint_positions = path.x[:: (len(path.x) - 1) // steps]
    coarse = np.linspace(0.0, last + span, _SAMPLES_PER_CUBIC * len(pace.times))
    waypoint_times = np.interp(waypoint_positions, compute_progress(coarse), coarse)
    for _ in range(_NEWTON_ITERATIONS):
        gaps = compute_progress(waypoint_times) - waypoint_positions
        steps_back = gaps / np.maximum(compute_speed(waypoint_times), 1e-12)
        waypoint_times[1:-1] -= np.clip(steps_back, -span, span)[1:-1]
    waypoint_times[0], waypoint_times[-1] = 0.0, last + span
    parts = int(np.ceil(np.diff(waypoint_times).max() / (_MAX_CUBIC_DURATION * span)))
    parts = max(_MIN_CUBICS_PER_STEP, parts)
    times = sample_intervals(waypoint_times, np.arange(parts) / parts, last=True)
    rows = path(np.clip(compute_progress(times), 0.0, length))
    rows[::parts] = path(waypoint_positions)
    interpolated = np.delete(np.arange(len(times)), [1, -2])
    knots = np.concatenate([np.repeat(times[0], 3), times, np.repeat(times[-1], 3)])
    at_rest = [(order, np.zeros(rows.shape[1])) for order in (1, 2)]
    spline = make_interp_spline(
        times[interpolated], rows[interpolated], k=3, t=knots, bc_type=(at_rest, at_rest)
    )
    rates = spline(times, 1)
    rates[[0, -1]] = 0.0
    return Curve(times, spline(times), rates)
