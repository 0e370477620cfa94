"""What bounds the speed of coordinates, and by how much a curve is too fast."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vkc_pin.utils.arrays import Floats
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
    def of(cls, scene: Scene, names: Sequence[str], jerk_time: float) -> Limits:
        """Return the limits (eqs. 4 and 5) of the robot's coordinates and "<object>.<joint>"; freedoms of grasps have none.

        Args:
            scene: Robot and objects.
            names: Of the coordinates.
            jerk_time: See `Options.jerk_time`.
        """
        robot, known = scene.robot, dict[str, tuple[float, ...]]()
        sources = [
            (
                "",
                robot.coordinates.names,
                (robot.lower, robot.upper, robot.velocity, robot.acceleration),
            )
        ]
        for owner, placed in scene.objects.items():
            item = placed.object
            sources.append(
                (
                    f"{owner}.",
                    item.coordinates.names,
                    (item.lower, item.upper, item.velocity, item.acceleration),
                )
            )
        for prefix, own, values in sources:
            known |= {
                prefix + name: tuple(row)
                for name, row in zip(own, np.transpose(values).tolist(), strict=True)
            }
        rows = np.array([known.get(name, (-np.inf, np.inf, np.inf, np.inf)) for name in names])
        lower, upper, velocity, acceleration = rows.T
        jerk = acceleration / jerk_time if jerk_time > 0.0 else np.full(len(names), np.inf)
        return cls(lower, upper, velocity, acceleration, jerk)

    def with_wheels(self, rolling: RollingLimits) -> Limits:
        """Return the limits of the wheels of a base, left and right, after the others.

        Nothing is said of their accelerations: what those of the base come to.
        """
        strongest = self.acceleration[:2].sum() + rolling.track / 2 * self.acceleration[2]
        wheel = (-np.inf, np.inf, rolling.wheel_speed, strongest, np.inf)
        return Limits(
            *(np.append(side, [value, value]) for side, value in zip(self, wheel, strict=True))
        )

    @property
    def jerky(self) -> bool:
        """Whether nothing bounds the jerk."""
        return not np.isfinite(self.jerk).any()

    def factor(self, curve: Curve) -> float:
        """Return how many times as long, at least 1, a curve must take to keep the limits of its rates of change."""
        fastest, strongest = curve.compute_max_rates()
        needed = [
            1.0,
            float((fastest / self.velocity).max()),
            float(np.sqrt((strongest / self.acceleration).max())),
        ]
        if not self.jerky:
            needed.append(float(np.cbrt((curve.compute_jerks()[0] / self.jerk).max())))
        return max(needed) * (1.0 + _ROUNDING)

    def slowed(self, curve: Curve) -> Curve:
        """Return a curve as it is, or slower by the factor that it takes to keep the limits."""
        factor = self.factor(curve)
        return Curve(curve.times * factor, curve.positions, curve.rates / factor)
