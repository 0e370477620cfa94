"""Computes joint placements as a function of minimal coordinates, symbolically and in batches."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import casadi as ca
import pinocchio as pin

from vkc_pin.planning import kinematics as cpin
from vkc_pin.planning.kinematics.batch import BatchFunction, estimate_size
from vkc_pin.utils.cache import Cache
from vkc_pin.world.models.coordinates import Coordinates

__all__ = ["Kinematics", "get_kinematics"]


class Kinematics:
    """Kinematics of one model; all symbolic users share its expressions."""

    def __init__(self, model: pin.Model) -> None:
        self._coordinates, self._function = Coordinates(model), cpin.joint_placements(model)

    def build_placements(self, z: Any) -> Any:
        """Return the placements of all joints at the symbols z, shape (n, 1), as (12, J − 1).

        See `cpin.joint_placements`.
        """
        return self._function(self._coordinates.q_symbolic(z))

    @cached_property
    def batch(self) -> BatchFunction:
        """Batch function z → columns of R and t of every joint's world placement, (12·(J − 1),)."""
        z = ca.SX.sym("z", self._coordinates.size)
        return BatchFunction(
            ca.Function("placements", [z], [ca.densify(self.build_placements(z))], {"cse": True})
        )

    @property
    def nbytes(self) -> int:
        """Estimated size in memory [bytes]."""
        return estimate_size(self._function) + (
            self.batch.nbytes if "batch" in self.__dict__ else 0
        )


def get_kinematics(model: pin.Model, cache: Cache) -> Kinematics:
    """Return the kinematics of a model, built if they are not in the cache."""
    return cache.get(("kinematics", model.saveToString()), lambda: Kinematics(model))
