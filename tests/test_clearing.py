from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from small_problems import door_scene

import vkc_pin as vkc
from vkc_pin.clearing import point_jacobians
from vkc_pin.knots import Knots


def drawn(steps: list[vkc.Grasp | vkc.Actuate | vkc.Touch], scene: vkc.Scene) -> tuple[vkc.TrajectoryProblem, Knots]:
    problem = vkc.build(scene, steps)
    return problem, Knots(problem, np.random.default_rng(0))


@pytest.mark.parametrize("seed", range(3))
def test_points_move_as_finite_differences_say(seed: int) -> None:
    """Against Pinocchio's own placements: a point fixed in a joint's frame, for every joint of a chain with a held door."""
    chain = vkc.consolidate(door_scene(), {"door": "handle_free"})
    rng, step = np.random.default_rng(seed), 1e-6
    z = rng.uniform(-1.0, 1.0, (2, chain.size))
    joints = np.tile(np.arange(chain.model.njoints), 2)
    which = np.repeat([0, 1], chain.model.njoints)
    local = rng.normal(size=(len(joints), 3))

    def points(at: np.ndarray) -> np.ndarray:
        found = np.empty((len(joints), 3))
        data = chain.model.createData()
        for k, (row, joint) in enumerate(zip(which, joints, strict=True)):
            pin.forwardKinematics(chain.model, data, chain.coordinates.q(at[row]))
            found[k] = data.oMi[int(joint)].act(local[k])
        return found

    jacobian = point_jacobians(chain, z, which, joints, points(z))
    assert jacobian.shape == (len(joints), 3, chain.size)
    for column in range(chain.size):
        change = np.zeros_like(z)
        change[:, column] = step
        differences = (points(z + change) - points(z - change)) / (2 * step)
        np.testing.assert_allclose(jacobian[:, :, column], differences, atol=1e-7)


def test_what_is_pushed_is_further_out_and_still_there() -> None:
    """Touching a cube under a table: most random configurations collide; pushing frees many more than there were."""
    scene = vkc.load_scene("init_1").with_held({"stick": "grip"}).with_start(base=[1.2, 1.0, 1.0])
    problem, knots = drawn([vkc.Touch("stick.tip", (-1.0, 3.897, 0.1))], scene)
    waypoint = problem.segments
    z, found = knots.knot(np.tile(problem.start, (96, 1)), waypoint, "scatter")
    z = z[found]
    before = knots.depth(z, waypoint)
    pushed = knots.clear(z, waypoint)
    after = knots.depth(pushed, waypoint)
    assert np.count_nonzero(after <= 0.0) >= np.count_nonzero(before <= 0.0) + 5
    residual, _ = problem.transcription.pose_solvers[0].evaluate(pushed[after <= 0.0], problem.targets[0])
    assert np.abs(residual).max() < 1e-3
    assert np.all(pushed >= problem.lower[-1] - 1e-12)
    assert np.all(pushed <= problem.upper[-1] + 1e-12)


def test_what_is_free_stays_where_it_is() -> None:
    problem, knots = drawn([vkc.Grasp("door")], door_scene())
    z, found = knots.knot(np.tile(problem.start, (96, 1)), problem.segments, "scatter")
    free = z[found][knots.depth(z[found], problem.segments) <= 0.0]
    assert len(free) > 3
    np.testing.assert_allclose(knots.clear(free, problem.segments), free, atol=0.05)
