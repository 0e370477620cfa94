"""Motions whose accelerations grow and fade: limits of jerk."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vkc_pin.planning.retiming.limits import Limits
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.trajectory.curve import Curve, sample_intervals

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline

__all__ = ["eased"]

_SPANS = np.geomspace(
    0.25, 4.0, 9
)  # of the average, as multiples of the time in which an acceleration may grow
_LEAST = 4  # cubics in a step, at least
_SHARE = 0.5  # of the average that a cubic may last
_LOOKS = 8  # places on a cubic, between which the time of a waypoint is sought
_ROUNDS = 6  # of Newton's method


def eased(path: CubicHermiteSpline, pace: Curve, steps: int, limits: Limits) -> Curve:
    """Return a curve along a path whose jerk is within limits, with accelerations that do not jump, from none to none.

    How far it has come, s(t), is replaced by its average over some time before: where s is twice
    differentiable but for jumps, its average is but for kinks, and goes neither back nor faster.
    Through places along the path at the times of that, closely, lead cubics that are twice
    differentiable, whose jerk is the same all along each; the second and the last but one are where
    that has them, so that there is no acceleration at both ends. They are slowed down until all
    limits are kept. Of several spans of the average, that one is taken with which they take least
    time.

    Args:
        path: The path; knots at the ends of each step, and as many in every step.
        pace: How far along it when, one coordinate, from rest to rest, beginning with 0 at 0 s.
        steps: How many.
        limits: Of the path's coordinates.
    """
    usual = float((limits.acceleration / limits.jerk)[np.isfinite(limits.jerk)].max())
    found = (limits.slowed(_averaged(path, pace, steps, share * usual)) for share in _SPANS)
    return min(found, key=lambda curve: float(curve.times[-1]))


def _averaged(path: CubicHermiteSpline, pace: Curve, steps: int, span: float) -> Curve:
    """Return the curve with an average over some time [s], before it is slowed down."""
    from scipy.interpolate import CubicHermiteSpline as Hermite
    from scipy.interpolate import make_interp_spline

    way = Hermite(pace.times, pace.positions[:, 0], pace.rates[:, 0])
    area, last, length = way.antiderivative(), float(pace.times[-1]), float(pace.positions[-1, 0])

    def gone(times: Floats) -> Floats:
        now, before = (
            area(np.clip(t, 0.0, last)) + length * np.maximum(t - last, 0.0)
            for t in (times, times - span)
        )
        return np.asarray((now - before) / span)

    def speed(times: Floats) -> Floats:
        now, before = (way(np.clip(t, 0.0, last)) for t in (times, times - span))
        return np.asarray((now - before) / span)

    places = path.x[:: (len(path.x) - 1) // steps]
    coarse = np.linspace(0.0, last + span, _LOOKS * len(pace.times))
    stops = np.interp(places, gone(coarse), coarse)
    for _ in range(_ROUNDS):
        stops[1:-1] -= np.clip(
            (gone(stops) - places) / np.maximum(speed(stops), 1e-12), -span, span
        )[1:-1]
    stops[0], stops[-1] = 0.0, last + span
    parts = max(_LEAST, int(np.ceil(np.diff(stops).max() / (_SHARE * span))))
    times = sample_intervals(stops, np.arange(parts) / parts, last=True)
    rows = path(np.clip(gone(times), 0.0, length))
    rows[::parts] = path(places)
    known = np.delete(np.arange(len(times)), [1, -2])
    knots = np.concatenate([np.repeat(times[0], 3), times, np.repeat(times[-1], 3)])
    still = [(order, np.zeros(rows.shape[1])) for order in (1, 2)]
    spline = make_interp_spline(times[known], rows[known], k=3, t=knots, bc_type=(still, still))
    rates = spline(times, 1)
    rates[[0, -1]] = 0.0
    return Curve(times, spline(times), rates)
