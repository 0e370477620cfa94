"""Holds the rate limits of coordinates and slows curves down to keep them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.articulated_object import ArticulatedObject
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.wheels import RollingLimits

__all__ = ["Limits"]

_ROUNDING = 1e-9  # relative


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
