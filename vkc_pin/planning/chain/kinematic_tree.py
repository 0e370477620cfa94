"""Builds the symbolic kinematics of a tree of joints, shared by all trees of one structure."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin

from vkc_pin.planning import kinematics as cpin
from vkc_pin.planning.kinematics.batch import BatchFunction, estimate_size
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.cache import Cache
from vkc_pin.world.collision.solids import flatten_placements
from vkc_pin.world.models.coordinates import Coordinates


@dataclass(frozen=True, eq=False)
class KinematicTree:
    """What symbolic kinematics depend on: a tree of joints, of which the last ones are mounted.

    Mounted joints are those of grasps and of the objects in the hand. How they are placed on their
    parents is measured or chosen, so these placements are arguments of all functions. Trees with
    equal `key` share their functions.

    Attributes:
        model: The model. The functions depend on neither its inertias, frames and limits, nor the
            placements of mounted joints.
        root: The model without mounted joints: the robot.
    """

    model: pin.Model
    root: pin.Model

    @property
    def mounted(self) -> tuple[int, ...]:
        """Indices of the mounted joints."""
        return tuple(range(self.root.njoints, self.model.njoints))

    @property
    def mount_count(self) -> int:
        """Number of placements in the functions' argument, at least one."""
        return max(len(self.mounted), 1)

    @cached_property
    def coordinates(self) -> Coordinates:
        """Minimal coordinates of the model."""
        return Coordinates(self.model)

    @cached_property
    def key(self) -> tuple[Any, ...]:
        """Cache key."""
        joints = [(self.model.joints[k].shortname(), self.model.parents[k]) for k in self.mounted]
        return self.root.saveToString(), *joints

    @cached_property
    def mounts(self) -> Floats:
        """Placements of the mounted joints on their parents, shape (m, 12), m at least 1.

        Rows are as of `flatten_placements`; without mounted joints there is one of zeros.
        """
        if not self.mounted:
            return np.zeros((1, 12))
        return flatten_placements([self.model.jointPlacements[joint] for joint in self.mounted])


class Kinematics:
    """Kinematics of one tree; all symbolic users share its expressions."""

    def __init__(self, tree: KinematicTree) -> None:
        self._tree = tree
        self._function = cpin.joint_placements(tree.model, tree.mounted)

    def build_placements(self, z: Any, mounts: Any) -> Any:
        """Return the placements of all joints as (12, J − 1); see `cpin.joint_placements`.

        Args:
            z: Symbols of the coordinates, shape (n, 1).
            mounts: Symbols of `KinematicTree.mounts`, one column each, shape (12, m).
        """
        inputs = [self._tree.coordinates.q_symbolic(z)]
        if self._tree.mounted:
            inputs.append(mounts)
        return self._function(*inputs)

    @cached_property
    def batch(self) -> BatchFunction:
        """Batch function (z, mounts) → world placements of all joints, (12·(J − 1),)."""
        z = ca.SX.sym("z", self._tree.coordinates.size)
        mounts = ca.SX.sym("P", 12, self._tree.mount_count)
        placements = ca.densify(self.build_placements(z, mounts))
        function = ca.Function("placements", [z, mounts], [placements], {"cse": True})
        return BatchFunction(function)

    @property
    def nbytes(self) -> int:
        """Estimated size in memory [bytes]."""
        size = estimate_size(self._function)
        if "batch" in self.__dict__:  # it has been built
            size += self.batch.nbytes
        return size


def get_kinematics(tree: KinematicTree, cache: Cache) -> Kinematics:
    """Return the kinematics of a tree, built if they are not in the cache."""
    return cache.get(("kinematics", tree.key), lambda: Kinematics(tree))
