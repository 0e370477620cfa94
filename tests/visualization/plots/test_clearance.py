from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from vkc_pin import Plan
from vkc_pin.visualization.plots.plots import ClearanceCurve, compute_clearance_curves
from vkc_pin.world.models.shapes import compute_shape_distance
from vkc_pin.world.trajectory.world_model import World

TIMES = np.linspace(0.0, 6.0, 13)


@pytest.fixture(scope="module")
def curves(plan: Plan) -> dict[str, ClearanceCurve]:
    found = compute_clearance_curves(plan.scene, plan.trajectory, TIMES)
    return {curve.name: curve for curve in found}


def test_clearance_curves_agree_with_coal(curves: dict[str, ClearanceCurve], plan: Plan) -> None:
    """The curve agrees with the minimum over all pairs and names the closest pair."""
    world, robot = World(plan.scene), plan.scene.robot
    data, shapes = world.model.createData(), world.collision.createData()
    assert list(curves) == [
        "robot – itself",
        "robot – objects",
        "robot – obstacles",
        "objects – surroundings",
        "gripper – grasped object",
    ]
    curve, count = curves["robot – obstacles"], len(robot.collision.geometryObjects)
    labels, objects = world.collision_labels, world.collision.geometryObjects
    pairs = [
        (i, j)
        for i in range(count)
        for j in range(count, len(labels))
        if "." not in labels[j] and not (labels[j] == "floor" and objects[i].parentJoint == 1)
    ]
    for k in (0, 6):
        q = world.coordinates.q(world.compute_positions(plan.trajectory, [TIMES[k]])[0])
        pin.updateGeometryPlacements(world.model, data, world.collision, shapes, q)
        nearest, pair = min(
            (
                compute_shape_distance(
                    objects[i].geometry, shapes.oMg[i], objects[j].geometry, shapes.oMg[j]
                ),
                (labels[i], labels[j]),
            )
            for i, j in pairs
        )
        assert curve.distances[k] == pytest.approx(nearest, abs=1e-5)
        assert curve.pairs[k] == pair


def test_closest_pair_and_its_time_are_reported(curves: dict[str, ClearanceCurve]) -> None:
    curve = curves["robot – objects"]
    distance, moment, pair = curve.closest()
    assert distance == curve.distances.min()
    assert moment in TIMES
    assert "door." in pair
