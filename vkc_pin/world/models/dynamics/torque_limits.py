"""Determines the torque limits of a robot's joints and discards implausible ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.coordinates import Coordinates

__all__ = ["UNLIMITED", "TorqueLimits", "compute_torque_limits"]

UNLIMITED = 1e300
"""Effort limits of Pinocchio above this mean that there is no limit."""
_SAMPLES = 200  # random configurations in which a motor must hold the arm


@dataclass(frozen=True, eq=False)
class TorqueLimits:
    """Torque and force limits of a robot's joints.

    Attributes:
        limits: Limit of each coordinate, shape (n,) [N·m], [N]; infinite for the base and where the
            limit is unknown.
        notes: Reasons why limits are unknown, one line each.
    """

    limits: Floats
    notes: tuple[str, ...] = ()

    @property
    def is_known(self) -> bool:
        """Whether any limit is known."""
        return bool(np.isfinite(self.limits).any())


def compute_torque_limits(
    model: pin.Model, coordinates: Coordinates, lower: Floats, upper: Floats
) -> TorqueLimits:
    """Return the torque limits of a robot.

    Limits are unknown if the URDF has no masses or no effort limit. They are also discarded if they
    cannot hold the arm at rest with an empty hand in all sampled configurations: such values are
    placeholders, or the model lacks a counterbalancing spring.

    Args:
        model: The robot; joint 1 is the base.
        coordinates: Coordinates of the robot; the first three are the base's.
        lower: Lower position limits, shape (n,) [m], [rad].
        upper: Upper position limits, shape (n,) [m], [rad].
    """
    limits = np.asarray(model.effortLimit, float)[: coordinates.size].copy()
    limits[:3] = np.inf
    if not sum(inertia.mass for inertia in list(model.inertias)[2:]) > 0.0:
        return TorqueLimits(np.full_like(limits, np.inf), ("the URDF states no masses of the arm",))
    stated = (limits > 0.0) & (limits < UNLIMITED)
    limits[~stated] = np.inf
    names, notes = np.array(coordinates.names), list[str]()
    if len(unstated := names[3:][~stated[3:]]):
        notes.append(f"the URDF states no effort of {', '.join(unstated)}")
    rng, data, gravity = np.random.default_rng(0), model.createData(), np.zeros_like(limits)
    low, high = np.maximum(lower, -np.pi), np.minimum(upper, np.pi)
    for z in rng.uniform(low, np.maximum(low, high), (_SAMPLES, len(low))):
        gravity = np.maximum(
            gravity, np.abs(pin.computeGeneralizedGravity(model, data, coordinates.q(z)))
        )
    for k in np.flatnonzero((gravity > limits) & stated):
        unit = {"m": "N", "rad": "N·m"}[coordinates.units[k]]
        notes.append(
            f"{names[k]}: the effort limit of {limits[k]:g} {unit} cannot hold the arm, "
            f"which needs up to {gravity[k]:.3g} {unit}"
        )
        limits[k] = np.inf
    return TorqueLimits(limits, tuple(notes))
