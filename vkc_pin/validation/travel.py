"""How far shapes move along a motion, at most."""

from __future__ import annotations

import numpy as np

from vkc_pin.arrays import Floats
from vkc_pin.validation.distances import Solids

__all__ = ["travelled"]


def travelled(solids: Solids, samples: Floats) -> Floats:
    """Return how far any point of each shape can have moved since the first sample, shape (S, G) [m].

    A joint's rotation moves a point by at most the angle times its distance from the axis, and that is at most the sum of the
    offsets of all joints between, and of the shape itself; a prismatic joint adds its travel.

    Args:
        solids: The shapes, G of them.
        samples: Configurations of their world, one after the other, shape (S, n).
    """
    world = solids.world
    model, steps = world.model, np.abs(np.diff(samples, axis=0))
    spans = np.linalg.norm(steps[:, :2], axis=1)
    offset = [float(np.linalg.norm(placement.translation)) for placement in model.jointPlacements]
    of_joint: dict[int, list[int]] = {}
    for index, joint in enumerate(world.coordinates.joints):
        of_joint.setdefault(joint, []).append(index)
    prismatic = {j: model.joints[j].shortname().startswith("JointModelP") and j > 1 for j in of_joint}
    found = np.zeros((len(samples), len(world.shapes)))
    for g, shape in enumerate(world.shapes[: solids.bodies]):
        reach = float(np.linalg.norm(solids.half[g])) + float(np.linalg.norm(shape.placement.act(solids.center[g])))
        joint, moved = shape.parentJoint, np.zeros(len(steps))
        while joint:
            columns = of_joint[joint]
            if len(columns) == 7:  # the free joint of what can be carried
                moved += _free(samples[:, columns], reach)
            elif len(columns) == 3:  # the planar base
                moved += spans + steps[:, columns[2]] * reach
            elif prismatic[joint]:
                moved += steps[:, columns[0]]
                reach += float(np.abs(samples[:, columns[0]]).max())
            else:
                moved += steps[:, columns[0]] * reach
            reach += offset[joint]
            joint = model.parents[joint]
        np.cumsum(moved, out=found[1:, g])
    return found


def _free(samples: Floats, reach: float) -> Floats:
    """Return how far a point at `reach` [m] from a free joint moves from each sample to the next, shape (S − 1,) [m]."""
    turns = samples[:, 3:] / np.linalg.norm(samples[:, 3:], axis=1, keepdims=True)
    half = np.arccos(np.clip(np.abs(np.einsum("kc,kc->k", turns[1:], turns[:-1])), 0.0, 1.0))
    return np.asarray(np.linalg.norm(np.diff(samples[:, :3], axis=0), axis=1) + 2.0 * half * reach)
