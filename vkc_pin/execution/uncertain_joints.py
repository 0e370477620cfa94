"""Lets links of estimated joints come near to their neighbours."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.clearance_exemptions import (
    ACCEPTED_SHORTFALL,
    MODEL_ERROR,
    PlacedShapes,
)
from vkc_pin.world.scene.placed_object import PlacedObject
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Actuate, Step

_PARTS = 20  # steps of a joint to its goal


def allow_near_neighbours(
    scene: Scene, name: str, joint: str, steps: Sequence[Step], dist_safe: float
) -> Scene:
    """Return a scene in which the links of an estimated joint may come near to their neighbours.

    Until it has moved far, a joint is known too roughly for a clearance of centimetres: 3° of a
    door leave 1° of its axis open. It is the mechanism that keeps the links from obstacles and
    other objects, not the robot. So they need no clearance from those near which the estimate leads
    them, and may be inside by an error of the model.

    Args:
        scene: Scene with the joint as estimated.
        name: The object.
        joint: Its joint.
        steps: Steps that move it.
        dist_safe: Clearance that others keep [m].
    """
    placed = scene.objects[name]
    values = _list_values(placed, joint, steps)
    shapes = PlacedShapes(scene, scene.objects)
    others = [k for k, label in enumerate(shapes.labels) if label.partition(".")[0] != name]
    if not others:
        return scene
    index = placed.object.coordinates.index(joint)
    for link in sorted(placed.object.links_moved_by({joint})):
        label = f"{name}.{link}"
        if label not in shapes.labels:  # a link without shapes
            continue
        distances = shapes.compute_distances(label, index, values, others, dist_safe)
        nearest = distances.min(axis=(0, 1))
        by_label = dict[str, float]()
        for other, distance in zip(others, nearest.tolist(), strict=True):
            neighbour = shapes.labels[other]
            by_label[neighbour] = min(distance, by_label.get(neighbour, np.inf))
        for neighbour, distance in by_label.items():
            if -MODEL_ERROR < distance < dist_safe:
                margin = min(distance - ACCEPTED_SHORTFALL, 0.0)
                scene = scene.with_allowed(label, neighbour, margin)
    return scene


def _list_values(placed: PlacedObject, joint: str, steps: Sequence[Step]) -> Floats:
    """Return values of a joint between its own and those that steps set, shape (V,)."""
    values = [placed.state[[placed.object.coordinates.index(joint)]]]
    for step in steps:
        if isinstance(step, Actuate) and step.object == placed.name and joint in step.joints:
            before = values[-1][-1]
            values.append(np.linspace(before, step.joints[joint], _PARTS + 1)[1:])
    return np.concatenate(values)
