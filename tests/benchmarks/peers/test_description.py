"""The chain as a URDF moves as the chain does, and looks at the same pairs."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from vkc_pin.benchmarks.peers.description import FRAME, describe
from vkc_pin.benchmarks.peers.sampled import compute_finite_limits
from vkc_pin.benchmarks.peers.tasks import TASKS, build_program, make_problem, sample_goals


@pytest.mark.parametrize("task", TASKS)
def test_description_has_the_same_kinematics_and_pairs(task: str, tmp_path: Path) -> None:
    problem = build_program(make_problem(task, 18, 0))
    files = describe(problem, tmp_path)
    model = pin.buildModelFromUrdf(str(files.urdf))
    data, order = model.createData(), [list(model.names)[1:].index(name) for name in files.joints]
    for row in sample_goals(problem, np.random.default_rng(0), 3):
        q = np.zeros(model.nq)
        q[order] = row
        pin.framesForwardKinematics(model, data, q)
        at = data.oMf[model.getFrameId(FRAME)]
        np.testing.assert_allclose(at.homogeneous, problem.targets[0].homogeneous, atol=1e-6)
    lower, upper = compute_finite_limits(problem)
    np.testing.assert_allclose(model.lowerPositionLimit[order], lower)
    np.testing.assert_allclose(model.upperPositionLimit[order], upper)
    (part,) = problem.contacts.phases
    assert len(files.margins) == len(part.pairs)
    disabled = ET.parse(files.srdf).findall("disable_collisions")
    assert not {frozenset((pair.get("link1"), pair.get("link2"))) for pair in disabled} & set(
        map(frozenset, files.margins)
    )


def test_inflated_shapes_collide_where_margins_are_violated(tmp_path: Path) -> None:
    problem = build_program(make_problem("drawer", 18, 0))
    files = describe(problem, tmp_path, inflated=True)
    model = pin.buildModelFromUrdf(str(files.urdf))
    shapes = pin.buildGeomFromUrdf(model, str(files.urdf), pin.GeometryType.COLLISION)
    numbers = {
        shape.name.rpartition("_")[0]: number for number, shape in enumerate(shapes.geometryObjects)
    }
    for one, other in files.margins:
        shapes.addCollisionPair(pin.CollisionPair(*sorted((numbers[one], numbers[other]))))
    order = [list(model.names)[1:].index(name) for name in files.joints]
    rng, lower, upper = np.random.default_rng(0), *compute_finite_limits(problem)
    z, agreed = rng.uniform(lower, upper, (60, len(lower))), 0
    contacts = problem.contacts.evaluate(z, np.ones(len(z), int), reach=0.1)
    for row, configuration in enumerate(z):
        slack = (contacts.distance - contacts.margin)[contacts.waypoint == row].min(initial=0.1)
        q = np.zeros(model.nq)
        q[order] = configuration
        hit = pin.computeCollisions(
            model, model.createData(), shapes, pin.GeometryData(shapes), q, True
        )
        if abs(slack) > 0.005:
            assert hit == (slack < 0.0), slack
            agreed += 1
    assert agreed > 40
