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
        limits_by_name = _list_limits(scene.robot, prefix="")
        for object_name, placed in scene.objects.items():
            limits_by_name |= _list_limits(placed.object, prefix=f"{object_name}.")
        unlimited = [-np.inf, np.inf, np.inf, np.inf]
        rows = np.array([limits_by_name.get(name, unlimited) for name in names])
        lower, upper, velocity, acceleration = rows.T
        jerk = np.full(len(names), np.inf)
        if jerk_time > 0.0:
            jerk = acceleration / jerk_time
        return cls(lower, upper, velocity, acceleration, jerk)

    def with_wheels(self, rolling: RollingLimits) -> Limits:
        """Return the limits with those of the left and right wheel appended.

        The wheels' acceleration is limited only by that of the base: a wheel at half the track b
        from the middle accelerates by at most |a_x| + |a_y| + b/2 |a_θ|.
        """
        acceleration = self.acceleration[:2].sum() + rolling.track / 2 * self.acceleration[2]
        return Limits(
            lower=np.append(self.lower, [-np.inf, -np.inf]),
            upper=np.append(self.upper, [np.inf, np.inf]),
            velocity=np.append(self.velocity, [rolling.wheel_speed, rolling.wheel_speed]),
            acceleration=np.append(self.acceleration, [acceleration, acceleration]),
            jerk=np.append(self.jerk, [np.inf, np.inf]),
        )

    @property
    def has_unlimited_jerk(self) -> bool:
        """Whether the jerk of no coordinate is limited."""
        return not np.isfinite(self.jerk).any()

    def compute_slowdown(self, curve: Curve) -> float:
        """Return the factor, at least 1, by which a curve must be slowed to keep its limits.

        Slowed down by k, it has 1/k of its velocities, 1/k² of its accelerations and 1/k³ of its
        jerks.
        """
        speeds, accelerations = curve.compute_max_rates()
        speed_ratio = (speeds / self.velocity).max()
        acceleration_ratio = (accelerations / self.acceleration).max()
        factors = [1.0, float(speed_ratio), float(np.sqrt(acceleration_ratio))]
        if not self.has_unlimited_jerk:
            jerks, _ = curve.compute_jerks()
            jerk_ratio = (jerks / self.jerk).max()
            factors.append(float(np.cbrt(jerk_ratio)))
        return max(factors) * (1.0 + _ROUNDING)

    def slow_down(self, curve: Curve) -> Curve:
        """Return a curve, slowed down as much as its rate limits require."""
        factor = self.compute_slowdown(curve)
        return Curve(curve.times * factor, curve.positions, curve.rates / factor)


def _list_limits(owner: Robot | ArticulatedObject, prefix: str) -> dict[str, list[float]]:
    """Return lower, upper, velocity and acceleration limit of each coordinate, by its name."""
    sides = (owner.lower, owner.upper, owner.velocity, owner.acceleration)
    limits_by_name = {}
    for name, limits in zip(owner.coordinates.names, np.transpose(sides).tolist(), strict=True):
        limits_by_name[prefix + name] = limits
    return limits_by_name


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
    # [s], in which the jerk limit lets the acceleration grow from zero to its limit
    rise_time = float((limits.acceleration[limited] / limits.jerk[limited]).max())
    candidates = []
    for factor in _SPAN_FACTORS:
        averaged = _average_pace(path, pace, steps, factor * rise_time)
        candidates.append(limits.slow_down(averaged))
    return min(candidates, key=lambda curve: float(curve.times[-1]))


def _average_pace(path: CubicPath, pace: Curve, steps: int, span: float) -> Curve:
    """Return the curve for an averaging interval `span` [s], before it is slowed down."""
    progress = _AveragedProgress(pace, span)
    waypoint_positions = path.x[:: (len(path.x) - 1) // steps]
    waypoint_times = progress.find_times(waypoint_positions)
    longest_step = np.diff(waypoint_times).max()
    parts = int(np.ceil(longest_step / (_MAX_CUBIC_DURATION * span)))
    parts = max(_MIN_CUBICS_PER_STEP, parts)
    times = sample_intervals(waypoint_times, np.arange(parts) / parts, last=True)
    rows = path(np.clip(progress.evaluate(times), 0.0, progress.length))
    rows[::parts] = path(waypoint_positions)
    return _interpolate_from_rest_to_rest(times, rows)


class _AveragedProgress:
    """The moving average of a pace s(t) over an interval T, which ends at rest T later.

        p(t) = (A(t) − A(t − T)) / T,   p'(t) = (s(t) − s(t − T)) / T

    A is the integral of s from 0 on; s is zero before its begin, and `length` after its end.

    Args:
        pace: Progress along a path over time, see `limit_jerk`.
        span: Averaging interval T [s].
    """

    def __init__(self, pace: Curve, span: float) -> None:
        from scipy.interpolate import CubicHermiteSpline as Hermite

        self._progress = Hermite(pace.times, pace.positions[:, 0], pace.rates[:, 0])
        self._area = self._progress.antiderivative()
        self._span = span
        self._sample_count = _SAMPLES_PER_CUBIC * len(pace.times)
        self._last = pace.times[-1]  # [s], the end of the pace itself
        self.length = pace.positions[-1, 0]

    def evaluate(self, times: Floats) -> Floats:
        """Return the averaged progress p at times [s]."""
        now = self._integrate(times)
        before = self._integrate(times - self._span)
        return np.asarray((now - before) / self._span)

    def find_times(self, positions: Floats) -> Floats:
        """Return the times [s] at which p attains increasing path positions, ends included."""
        span = self._span
        end = self._last + span
        # Samples bracket the times; Newton's method refines all but the known ones at the ends.
        samples = np.linspace(0.0, end, self._sample_count)
        times = np.interp(positions, self.evaluate(samples), samples)
        for _ in range(_NEWTON_ITERATIONS):
            gaps = self.evaluate(times) - positions
            steps_back = gaps / np.maximum(self._evaluate_speed(times), 1e-12)
            times[1:-1] -= np.clip(steps_back, -span, span)[1:-1]
        times[0] = 0.0
        times[-1] = end
        return times

    def _integrate(self, times: Floats) -> Floats:
        within = self._area(np.clip(times, 0.0, self._last))
        return np.asarray(within + self.length * np.maximum(times - self._last, 0.0))

    def _evaluate_speed(self, times: Floats) -> Floats:
        now = self._progress(np.clip(times, 0.0, self._last))
        before = self._progress(np.clip(times - self._span, 0.0, self._last))
        return np.asarray((now - before) / self._span)


def _interpolate_from_rest_to_rest(times: Floats, rows: Floats) -> Curve:
    """Return a curve of twice differentiable cubics through rows of coordinates, (K, n).

    With knots at all times, the spline has K + 2 coefficients. Zero velocity and acceleration at
    both ends are four conditions, so that K − 2 rows are interpolated: not those beside the ends.
    """
    from scipy.interpolate import make_interp_spline

    interpolated = np.delete(np.arange(len(times)), [1, -2])
    knots = np.concatenate([np.repeat(times[0], 3), times, np.repeat(times[-1], 3)])
    zero = np.zeros(rows.shape[1])
    at_rest = [(1, zero), (2, zero)]
    spline = make_interp_spline(
        times[interpolated], rows[interpolated], k=3, t=knots, bc_type=(at_rest, at_rest)
    )
    rates = spline(times, 1)
    rates[[0, -1]] = 0.0
    return Curve(times, spline(times), rates)
