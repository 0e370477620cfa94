"""Tests the URDF of a chain: its kinematics, collision pairs and margins."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from tests.benchmarks.peers.description import FRAME, describe
from tests.benchmarks.peers.sampled import compute_finite_limits
from tests.benchmarks.peers.tasks import TASKS, build_program, make_problem, sample_goals


@pytest.mark.parametrize(
    "task",
    [task if task == "door" else pytest.param(task, marks=pytest.mark.long) for task in TASKS],
)
def test_description_has_the_same_kinematics_and_pairs(task: str, tmp_path: Path) -> None:
    problem = build_program(make_problem(task, 18, 0))
    files = describe(problem, tmp_path)
    model = pin.buildModelFromUrdf(str(files.urdf))
    data = model.createData()
    order = [list(model.names)[1:].index(name) for name in files.joints]
    for row in sample_goals(problem, np.random.default_rng(0), 3):
        q = np.zeros(model.nq)
        q[order] = row
        pin.framesForwardKinematics(model, data, q)
        placement = data.oMf[model.getFrameId(FRAME)]
        np.testing.assert_allclose(placement.homogeneous, problem.targets[0].homogeneous, atol=1e-6)
    lower, upper = compute_finite_limits(problem)
    np.testing.assert_allclose(model.lowerPositionLimit[order], lower)
    np.testing.assert_allclose(model.upperPositionLimit[order], upper)
    (phase,) = problem.contacts.phases
    assert len(files.margins) == len(phase.pairs)
    disabled = ET.parse(files.srdf).findall("disable_collisions")
    assert not {frozenset((pair.get("link1"), pair.get("link2"))) for pair in disabled} & set(
        map(frozenset, files.margins)
    )


@pytest.mark.parametrize("by_body", [False, True])
def test_shapes_violate_the_same_margins(by_body: bool, tmp_path: Path) -> None:
    problem = build_program(make_problem("drawer", 18, 0))
    files = describe(problem, tmp_path, by_body=by_body)
    model = pin.buildModelFromUrdf(str(files.urdf))
    shapes = pin.buildGeomFromUrdf(model, str(files.urdf), pin.GeometryType.COLLISION)
    numbers = {
        shape.name.rpartition("_")[0]: number for number, shape in enumerate(shapes.geometryObjects)
    }
    by_bodies: dict[tuple[int, ...], set[float]] = {}
    for (one, other), margin in files.margins.items():
        pair = sorted((numbers[one], numbers[other]))
        shapes.addCollisionPair(pin.CollisionPair(*pair))
        bodies = sorted(shapes.geometryObjects[number].parentJoint for number in pair)
        by_bodies.setdefault(tuple(bodies), set()).add(margin)
    assert all(len(margins) == 1 for margins in by_bodies.values())
    assert any(margins != {0.0} for margins in by_bodies.values()) == by_body
    data = pin.GeometryData(shapes)
    for number, margin in enumerate(files.margins.values()):
        data.collisionRequests[number].security_margin = margin
    order = [list(model.names)[1:].index(name) for name in files.joints]
    rng, lower, upper = np.random.default_rng(0), *compute_finite_limits(problem)
    z = rng.uniform(lower, upper, (60, len(lower)))
    agreed = 0
    contacts = problem.contacts.evaluate(z, np.ones(len(z), int), reach=0.1)
    for row, configuration in enumerate(z):
        slack = (contacts.distance - contacts.margin)[contacts.waypoint == row].min(initial=0.1)
        q = np.zeros(model.nq)
        q[order] = configuration
        in_collision = pin.computeCollisions(model, model.createData(), shapes, data, q, True)
        if abs(slack) > 0.005:
            assert in_collision == (slack < 0.0), slack
            agreed += 1
    assert agreed > 40
