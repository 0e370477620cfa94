"""Placements of a model's joints as a function of its minimal coordinates: for symbols, and for numbers in batches."""

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
    """The kinematics of one model; what needs them symbolically takes the same expressions."""

    def __init__(self, model: pin.Model) -> None:
        self._coordinates, self._function = Coordinates(model), cpin.joint_placements(model)

    def symbolic(self, z: Any) -> Any:
        """Return the placements of all joints at the symbols z, shape (n, 1): shape (12, J − 1), see `cpin.joint_placements`."""
        return self._function(self._coordinates.q_symbolic(z))

    @cached_property
    def batch(self) -> BatchFunction:
        """Z → (12·(J − 1),): by columns R and t of every joint's placement in the world, for many rows at once."""
        z = ca.SX.sym("z", self._coordinates.size)
        return BatchFunction(
            ca.Function("placements", [z], [ca.densify(self.symbolic(z))], {"cse": True})
        )

    @property
    def nbytes(self) -> int:
        """Its size in memory, estimated [bytes]."""
        return estimate_size(self._function) + (
            self.batch.nbytes if "batch" in self.__dict__ else 0
        )


def get_kinematics(model: pin.Model, cache: Cache) -> Kinematics:
    """Return the kinematics of a model, built if they are not in the cache."""
    return cache.get(("kinematics", model.saveToString()), lambda: Kinematics(model))
