"""Checks velocities, accelerations and jerks of a motion against their limits."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vkc_pin.options import Options
from vkc_pin.utils.arrays import Floats
from vkc_pin.validation.report import Violation
from vkc_pin.validation.samples import Samples

__all__ = ["check_rates"]

ACCEPTED_RATE_TOLERANCE = 1e-3  # relative excess over a limit
REST_TOLERANCE = 1e-6  # [m/s] or [rad/s]
JUMP_TOLERANCE = 1e-3  # jump of an acceleration, relative to its limit


def check_rates(samples: Samples, options: Options) -> Iterator[Violation]:
    """Yield the worst violations of velocity and acceleration limits (eq. 5) and of jerk limits.

    A curve must begin and end at rest. Accelerations are evaluated at the ends of its cubics, where
    they are largest. The jerk of each cubic is constant; with jerk limits, accelerations must not
    jump between cubics. Jerks of a motion without a curve are not checked, as its velocities jump.
    """
    motion, curve = samples.trajectory, samples.trajectory.curve
    jerks: tuple[Floats, Floats] | None = None
    if curve is None:
        moments, rests = motion.times, np.zeros((2, len(motion.names)))
        velocities, accelerations = motion.velocities(), motion.accelerations()
    else:
        moments, rests = curve.times, np.abs(curve.rates[[0, -1]])
        velocities, accelerations = curve.compute_max_rates()
        jerks = curve.compute_jerks() if options.jerk_time > 0.0 else None
    for i, name in enumerate(motion.names):
        _, _, fastest, strongest = samples.get_limits(name)
        looks = [
            ("velocity", velocities[:, i], fastest, "s", moments),
            ("acceleration", accelerations[:, i], strongest, "s²", moments),
            ("velocity", rests[:, i], REST_TOLERANCE, "s", motion.times[[0, -1]]),
        ]
        if jerks is not None and np.isfinite(strongest):
            looks.append(("jerk", jerks[0][:, i], strongest / options.jerk_time, "s³", moments))
            looks.append(
                ("jerk", jerks[1][:, i], JUMP_TOLERANCE * strongest, "s² at once", moments)
            )
        unit = samples.get_unit(name)
        for kind, values, limit, per, when in looks:
            worst = int(np.argmax(np.abs(values)))
            value = abs(float(values[worst]))
            if not value <= limit * (1 + ACCEPTED_RATE_TOLERANCE) + 1e-9:
                at = max(int(np.searchsorted(motion.times, when[worst], side="right")) - 1, 0)
                detail = f"{value:.3f} {unit}/{per} is more than {limit:.3f} {unit}/{per}"
                yield samples.make_violation(
                    kind, name, value - limit, f"{unit}/{per}", detail, waypoint=at
                )
