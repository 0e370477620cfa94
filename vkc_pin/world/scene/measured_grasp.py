"""Relates the measured pose of a hand in a grasp to the attachment that it was to grasp."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.articulated_object import Attachment

__all__ = [
    "MAX_ANGLE_DEVIATION",
    "MAX_POSITION_DEVIATION",
    "apply_deviation",
    "check_deviation",
    "fit_grasp",
]

MAX_POSITION_DEVIATION = 0.02
"""Largest distance of a measured hand from its attachment [m]."""
MAX_ANGLE_DEVIATION = 0.2
"""Largest angle between a measured hand and its attachment [rad]."""
_DECIMALS = 9  # of a deviation: converting it to a pose and back gives the same numbers
_SLACK = 1e-9  # [m] or [rad] of rounding
_MAX_STARTS = 81  # combinations of lower end, middle and upper end of the freedoms


def apply_deviation(attachment: Attachment, deviation: Sequence[float]) -> Attachment:
    """Return an attachment with a deviation, see `Hold.deviation`; none if it is empty."""
    if not deviation:
        return attachment
    turn, shift = pin.exp3(np.array(deviation[3:])), np.array(deviation[:3])
    return dataclasses.replace(attachment, deviation=pin.SE3(turn, shift))


def fit_grasp(
    attachment: Attachment,
    measured: pin.SE3,
    values: Sequence[float] | None,
    field: str,
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return freedoms and deviation of a measured grasp.

    Args:
        attachment: Nominal attachment.
        measured: Measured placement of its frame in the grasping frame.
        values: Values of the freedoms, [m] and [rad]; None: those with the smallest deviation.
        field: Name of the measured pose, for messages.

    Returns:
        Values of the freedoms, and `Hold.deviation`: empty if it is zero.

    Raises:
        InputError: The hand is too far from the attachment.
    """
    hand = measured.inverse()

    def compute_deviation(at: Sequence[float] | Floats) -> Floats:
        off = attachment.motion(at).actInv(hand)
        return np.concatenate([off.translation, pin.log3(off.rotation)])

    if values is None:
        values = _fit_freedoms(attachment, compute_deviation)
    found = np.round(compute_deviation(values), _DECIMALS) + 0.0  # no negative zeros
    check_deviation(found, field)
    return tuple(float(value) for value in values), tuple(found.tolist()) if found.any() else ()


def check_deviation(deviation: Sequence[float] | Floats, field: str) -> None:
    """Check that a hand is near its attachment. Raises `InputError` if it is not."""
    position, angle = (float(np.linalg.norm(part)) for part in (deviation[:3], deviation[3:]))
    if position > MAX_POSITION_DEVIATION + _SLACK or angle > MAX_ANGLE_DEVIATION + _SLACK:
        raise InputError(
            "the hand is too far from the attachment",
            field=field,
            expected=f"within {1e3 * MAX_POSITION_DEVIATION:g} mm and {MAX_ANGLE_DEVIATION:g} rad",
            got=f"{1e3 * position:.1f} mm and {angle:.3f} rad from it",
        )


def _fit_freedoms(
    attachment: Attachment, compute_deviation: Callable[[Floats], Floats]
) -> tuple[float, ...]:
    """Return the values of the freedoms within their limits with the smallest deviation."""
    if not attachment.freedoms:
        return ()
    from scipy.optimize import least_squares

    scale = np.repeat([MAX_POSITION_DEVIATION, MAX_ANGLE_DEVIATION], 3)
    lower, upper = np.array([(one.lower, one.upper) for one in attachment.freedoms]).T
    starts = itertools.product(*zip(lower, (lower + upper) / 2.0, upper, strict=True))
    fits = (
        least_squares(
            lambda at: compute_deviation(at) / scale,
            np.clip(start, lower, upper),
            bounds=(lower, upper),
            xtol=1e-12,
            ftol=1e-12,
            gtol=1e-12,
        )
        for start in itertools.islice(starts, _MAX_STARTS)
    )
    return tuple(min(fits, key=lambda fit: float(fit.cost)).x.tolist())
