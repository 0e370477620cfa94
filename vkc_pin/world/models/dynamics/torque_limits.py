"""The torques that a robot's motors have, as far as its description can be relied upon."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.coordinates import Coordinates

__all__ = ["UNLIMITED", "TorqueLimits", "compute_torque_limits"]

UNLIMITED = 1e300
"""Pinocchio's efforts above this are none."""
_SAMPLES = 200  # random ones in which a motor has to hold its own arm


@dataclass(frozen=True, eq=False)
class TorqueLimits:
    """What the motors of a robot have.

    Attributes:
        limits: Of torque or force of each coordinate, shape (n,) [N·m], [N]; infinite for the base,
            and where nothing is known.
        notes: Why nothing is known of some, one line each.
    """

    limits: Floats
    notes: tuple[str, ...] = ()

    @property
    def is_known(self) -> bool:
        """Whether any is known."""
        return bool(np.isfinite(self.limits).any())


def compute_torque_limits(
    model: pin.Model, coordinates: Coordinates, lower: Floats, upper: Floats
) -> TorqueLimits:
    """Return what the motors of a robot have.

    Nothing is known without masses, or where no effort is stated. Where the stated effort does not
    hold the arm itself in all postures, with an empty hand and at rest, it is not what the motor
    has: a placeholder, or a spring is left out.

    Args:
        model: The robot; joint 1 is the base.
        coordinates: Its coordinates, the first three of which are the base's.
        lower: Least positions, shape (n,) [m], [rad].
        upper: Largest positions, shape (n,).
    """
    limits = np.asarray(model.effortLimit, float)[: coordinates.size].copy()
    limits[:3] = np.inf
    if not sum(inertia.mass for inertia in list(model.inertias)[2:]) > 0.0:
        return TorqueLimits(np.full_like(limits, np.inf), ("the URDF states no masses of the arm",))
    stated = (limits > 0.0) & (limits < UNLIMITED)
    limits[~stated] = np.inf
    names, notes = np.array(coordinates.names), list[str]()
    if len(silent := names[3:][~stated[3:]]):
        notes.append(f"the URDF states no effort of {', '.join(silent)}")
    rng, data, weight = np.random.default_rng(0), model.createData(), np.zeros_like(limits)
    low, high = np.maximum(lower, -np.pi), np.minimum(upper, np.pi)
    for z in rng.uniform(low, np.maximum(low, high), (_SAMPLES, len(low))):
        weight = np.maximum(
            weight, np.abs(pin.computeGeneralizedGravity(model, data, coordinates.q(z)))
        )
    for k in np.flatnonzero((weight > limits) & stated):
        unit = {"m": "N", "rad": "N·m"}[coordinates.units[k]]
        notes.append(
            f"{names[k]}: {limits[k]:g} {unit} do not carry the arm, which weighs up to {weight[k]:.3g} {unit} there"
        )
        limits[k] = np.inf
    return TorqueLimits(limits, tuple(notes))
