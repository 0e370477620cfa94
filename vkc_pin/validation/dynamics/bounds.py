"""Finds the limits that bound the speed of a motion, from the nearest limit of each cubic."""

from __future__ import annotations

import itertools

import numpy as np

from vkc_pin.utils.arrays import Floats
from vkc_pin.validation.report import Bound
from vkc_pin.validation.samples import Samples
from vkc_pin.world.trajectory.dynamics.torques import MotionSamples

__all__ = ["find_limiting_constraints"]

_MOTION_TOLERANCE = 1e-9  # relative to a limit
_MIN_SHARE = 5e-3  # smaller shares of the duration are not reported


def find_limiting_constraints(
    samples: Samples, moments: MotionSamples, torques: Floats, jerk_time: float
) -> tuple[Bound, ...]:
    """Find the limits that bound the speed of a motion, by decreasing share of the duration.

    Args:
        samples: Sampled motion. Without a curve the result is empty.
        moments: Motion at K times.
        torques: Torques at these times relative to their limits, shape (K, robot coordinates).
        jerk_time: See `Options.jerk_time`.
    """
    curve, names = samples.trajectory.curve, samples.trajectory.names
    if curve is None:
        return ()
    limits = np.array([samples.get_limits(name)[2:] for name in names]).T
    shares = [rates / limit for rates, limit in zip(curve.compute_max_rates(), limits, strict=True)]
    shares.append(jerk_time * curve.compute_jerks()[0] / limits[1])
    shares.append(np.zeros((len(curve.times) - 1, torques.shape[1])))
    np.maximum.at(shares[-1], moments.pieces, torques)
    every = np.hstack(shares)
    labels = [(name, kind) for kind in ("velocity", "acceleration", "jerk") for name in names]
    labels += [(name, "torque") for name in names[: torques.shape[1]]]
    moving = (np.hstack(shares[:2]) > _MOTION_TOLERANCE).any(axis=1)
    nearest = np.where(moving, every.argmax(axis=1), len(labels))
    spans, found = np.diff(curve.times), list[Bound]()
    edges = np.concatenate([[0], np.flatnonzero(np.diff(nearest)) + 1, [len(nearest)]])
    for number in np.unique(nearest).tolist():
        stretches = [
            (curve.times[a], curve.times[b])
            for a, b in itertools.pairwise(edges)
            if nearest[a] == number
        ]
        begin, end = max(stretches, key=lambda stretch: float(stretch[1] - stretch[0]))
        name, kind = (*labels, ("", "rest"))[number]
        share = float(spans[nearest == number].sum() / spans.sum())
        found.append(Bound(name, kind, share=share, begin=float(begin), end=float(end)))
    return tuple(
        sorted(
            (bound for bound in found if bound.share >= _MIN_SHARE), key=lambda bound: -bound.share
        )
    )
