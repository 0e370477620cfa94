"""Inverse kinematics, its solutions checked with numeric Pinocchio."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from helpers.small_problems import door_scene, full_scene, random_configurations

from vkc_pin.planning.chain.chain import VirtualKinematicChain, consolidate
from vkc_pin.planning.chain.inverse_kinematics import PoseSolver
from vkc_pin.planning.chain.pose import PoseRow

GRASPS = [{}, {"door": "handle"}, {"cabinet": "ball"}]


@pytest.fixture(params=GRASPS, ids=["robot", "door", "ball"])
def chain(request: pytest.FixtureRequest) -> VirtualKinematicChain:
    return consolidate(full_scene(), request.param)


def solver_and_frame(chain: VirtualKinematicChain) -> tuple[PoseSolver, int, pin.SE3]:
    """Return a solver of the last frame there is: the tool, or what is at the chain's end."""
    name = chain.robot.tool_frame
    if chain.closures:
        (closure,) = chain.closures.values()
        return (
            PoseSolver(chain.model, PoseRow(closure.joint, closure.local, ())),
            closure.joint,
            closure.local,
        )
    frame = chain.model.frames[chain.model.getFrameId(name)]
    return (
        PoseSolver(chain.model, PoseRow(frame.parentJoint, pin.SE3(frame.placement), ())),
        frame.parentJoint,
        pin.SE3(frame.placement),
    )


def placement(chain: VirtualKinematicChain, joint: int, local: pin.SE3, z: np.ndarray) -> pin.SE3:
    data = chain.model.createData()
    pin.forwardKinematics(chain.model, data, chain.coordinates.q(z))
    return data.oMi[joint] * local


def errors(
    chain: VirtualKinematicChain, joint: int, local: pin.SE3, z: np.ndarray, target: pin.SE3
) -> np.ndarray:
    """Return distance [m] or angle [rad] to the target, whichever is larger, shape (B,)."""
    found = [placement(chain, joint, local, row) for row in z]
    return np.array(
        [
            max(
                np.linalg.norm(p.translation - target.translation),
                np.linalg.norm(pin.log3(target.rotation.T @ p.rotation)),
            )
            for p in found
        ]
    )


def limits(chain: VirtualKinematicChain) -> tuple[np.ndarray, np.ndarray]:
    lower, upper = chain.lower.copy(), chain.upper.copy()
    lower[:2], upper[:2] = -3.0, 3.0
    return lower, upper


def test_residual_and_jacobian(chain: VirtualKinematicChain) -> None:
    solver, joint, local = solver_and_frame(chain)
    z = random_configurations(chain.lower, chain.upper, 10, np.random.default_rng(0))
    target = placement(chain, joint, local, z[0])
    residual, jacobian = solver.evaluate(z, target)
    assert residual.shape == (10, 6)
    assert jacobian.shape == (10, 6, chain.size)
    np.testing.assert_allclose(residual[0], 0.0, atol=1e-9)
    for row in range(10):
        at = placement(chain, joint, local, z[row])
        turn = pin.log3(target.rotation.T @ at.rotation)
        angle = max(np.linalg.norm(turn), 1e-12)
        expected = np.r_[at.translation - target.translation, 2 * np.sin(angle / 2) * turn / angle]
        np.testing.assert_allclose(residual[row], expected, rtol=0.0, atol=1e-8)
        change = 1e-6 * np.eye(chain.size)
        ahead, behind = (
            solver.evaluate(z[row] + change, target)[0],
            solver.evaluate(z[row] - change, target)[0],
        )
        np.testing.assert_allclose(jacobian[row], (ahead - behind).T / 2e-6, rtol=0.0, atol=1e-6)


def test_solutions_reach_the_pose_within_limits(chain: VirtualKinematicChain) -> None:
    solver, joint, local = solver_and_frame(chain)
    lower, upper = limits(chain)
    rng = np.random.default_rng(1)
    targets = random_configurations(chain.lower, chain.upper, 8, rng, arena=1.0)
    solved = 0
    for row in targets:
        target = placement(chain, joint, local, row)
        seeds = np.clip(row + rng.uniform(-0.5, 0.5, (40, chain.size)), chain.lower, chain.upper)
        z, found = solver.solve(
            seeds, target, lower=lower, upper=upper, weights=np.ones(chain.size), iterations=25
        )
        assert z.shape == seeds.shape
        assert found.shape == (40,)
        assert np.all(z >= lower)
        assert np.all(z <= upper)
        missing = errors(chain, joint, local, z, target)
        assert np.all(missing[found] < 3e-6)  # each of six residuals is below 1e-6
        assert np.all(missing[~found] > 5e-7)
        solved += int(found.sum())
    assert solved > 0.7 * 40 * len(targets)


def test_seeds_that_fit_are_left_alone(chain: VirtualKinematicChain) -> None:
    solver, joint, local = solver_and_frame(chain)
    z = random_configurations(chain.lower, chain.upper, 1, np.random.default_rng(2))
    lower, upper = limits(chain)
    target = placement(chain, joint, local, z[0])
    same, found = solver.solve(z, target, lower=lower, upper=upper, weights=np.ones(chain.size))
    assert found.all()
    np.testing.assert_array_equal(same, z)


def test_what_cannot_be_reached_is_said() -> None:
    chain = consolidate(door_scene(), {})
    solver, _, _ = solver_and_frame(chain)
    lower, upper = limits(chain)
    seeds = random_configurations(chain.lower, chain.upper, 30, np.random.default_rng(3))
    z, found = solver.solve(
        seeds,
        pin.SE3(np.eye(3), np.array([0.0, 0.0, 9.0])),
        lower=lower,
        upper=upper,
        weights=np.ones(chain.size),
    )
    assert not found.any()
    assert np.all(np.isfinite(z))
    assert np.all((z >= lower) & (z <= upper))


def test_equal_limits_keep_coordinates_where_they_are() -> None:
    """For all configurations alike, and for each its own."""
    chain = consolidate(door_scene(), {})
    solver, joint, local = solver_and_frame(chain)
    rng = np.random.default_rng(4)
    goal = np.concatenate([[0.5, -0.3, 0.4], chain.robot.home])
    target = placement(chain, joint, local, goal)
    seeds = goal + rng.uniform(-0.3, 0.3, (40, chain.size))
    lower, upper = limits(chain)
    lower[5] = upper[5] = goal[5]
    z, found = solver.solve(
        seeds, target, lower=lower, upper=upper, weights=np.ones(chain.size), iterations=25
    )
    assert found.mean() > 0.8
    assert np.all(z[:, 5] == goal[5])
    rows_lower, rows_upper = np.tile(limits(chain)[0], (40, 1)), np.tile(limits(chain)[1], (40, 1))
    rows_lower[:, 2] = rows_upper[:, 2] = seeds[:, 2]
    z, found = solver.solve(
        seeds,
        target,
        lower=rows_lower,
        upper=rows_upper,
        weights=np.ones(chain.size),
        iterations=25,
    )
    assert found.mean() > 0.8
    np.testing.assert_array_equal(z[:, 2], seeds[:, 2])
    assert np.all(errors(chain, joint, local, z[found], target) < 3e-6)


def test_a_limit_in_the_way_is_respected_and_got_round() -> None:
    chain = consolidate(door_scene(), {})
    solver, joint, local = solver_and_frame(chain)
    goal = np.concatenate([[0.0, 0.0, 0.0], chain.robot.home])
    target = placement(chain, joint, local, goal)
    rng = np.random.default_rng(5)
    seeds = goal + rng.uniform(-0.1, 0.1, (40, chain.size))
    seeds[:, 0] = -0.2 - rng.uniform(0.0, 0.03, 40)
    lower, upper = limits(chain)
    farthest = []
    for edge in (3.0, -0.2):  # how far the base may come
        upper[0] = edge
        z, found = solver.solve(
            seeds, target, lower=lower, upper=upper, weights=np.ones(chain.size), iterations=40
        )
        assert found.mean() > 0.8
        farthest.append(z[found, 0].max())
    assert farthest[0] > -0.15
    assert farthest[1] <= -0.2


def test_what_is_dear_to_move_moves_less() -> None:
    chain = consolidate(door_scene(), {})
    solver, joint, local = solver_and_frame(chain)
    goal = np.concatenate([[0.0, 0.0, 0.0], chain.robot.home])
    target = placement(chain, joint, local, goal)
    seeds = goal + np.random.default_rng(6).uniform(-0.2, 0.2, (60, chain.size))
    lower, upper = limits(chain)
    travel = []
    for weight in (0.1, 100.0):
        weights = np.ones(chain.size)
        weights[:3] = weight
        z, found = solver.solve(
            seeds, target, lower=lower, upper=upper, weights=weights, iterations=30
        )
        assert found.mean() > 0.8
        travel.append(np.abs(z - seeds)[found, :3].sum(axis=1).mean())
    assert travel[1] < 0.3 * travel[0]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_half_a_turn_away_is_not_taken_for_there(axis: int) -> None:
    chain = consolidate(door_scene(), {})
    solver, joint, local = solver_and_frame(chain)
    start = np.concatenate([[0.0, 0.0, 0.0], chain.robot.home])
    about = pin.AngleAxis(np.pi, np.eye(3)[axis]).matrix()
    target = placement(chain, joint, local, start) * pin.SE3(about, np.zeros(3))
    residual, _ = solver.evaluate(start[None], target)
    assert np.linalg.norm(residual[0, 3:]) > 0.5
    lower, upper = limits(chain)
    z, found = solver.solve(
        start[None], target, lower=lower, upper=upper, weights=np.ones(chain.size), iterations=60
    )
    assert found.all() == (errors(chain, joint, local, z, target) < 3e-6).all()


# --- points, and what stands upright
# ----------------------------------------------------------------------------------


def tilt(placement: pin.SE3, target: pin.SE3) -> float:
    """Return the angle [rad] between the body's and the target's vertical."""
    vertical = target.rotation.T @ np.array([0.0, 0.0, 1.0])
    return float(np.arccos(np.clip((placement.rotation @ vertical)[2], -1.0, 1.0)))


@pytest.mark.parametrize(("kind", "rows"), [("point", 3), ("upright", 5)])
def test_residuals_and_jacobians_of_other_goals(
    chain: VirtualKinematicChain, kind: str, rows: int
) -> None:
    _, joint, local = solver_and_frame(chain)
    solver = PoseSolver(chain.model, PoseRow(joint, local, (), kind))
    z = random_configurations(chain.lower, chain.upper, 10, np.random.default_rng(7))
    target = placement(chain, joint, local, z[0])
    assert (solver.rows, solver.size) == (rows, chain.size)
    residual, jacobian = solver.evaluate(z, target)
    assert residual.shape == (10, rows)
    assert jacobian.shape == (10, rows, chain.size)
    np.testing.assert_allclose(residual[0], 0.0, atol=1e-9)
    for row in range(10):
        at = placement(chain, joint, local, z[row])
        np.testing.assert_allclose(
            residual[row, :3], at.translation - target.translation, rtol=0.0, atol=1e-9
        )
        if kind == "upright":
            assert np.linalg.norm(residual[row, 3:]) == pytest.approx(
                2 * np.sin(tilt(at, target) / 2), abs=1e-7
            )
        change = 1e-6 * np.eye(chain.size)
        ahead, behind = (
            solver.evaluate(z[row] + change, target)[0],
            solver.evaluate(z[row] - change, target)[0],
        )
        np.testing.assert_allclose(jacobian[row], (ahead - behind).T / 2e-6, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("kind", ["point", "upright"])
def test_other_goals_are_reached_within_limits_at_what_orientation_they_leave(
    chain: VirtualKinematicChain, kind: str
) -> None:
    _, joint, local = solver_and_frame(chain)
    solver, (lower, upper) = PoseSolver(chain.model, PoseRow(joint, local, (), kind)), limits(chain)
    rng = np.random.default_rng(8)
    solved, turned = 0, 0.0
    targets = random_configurations(chain.lower, chain.upper, 8, rng, arena=1.0)
    for row in targets:
        target = placement(chain, joint, local, row)
        seeds = np.clip(row + rng.uniform(-0.7, 0.7, (30, chain.size)), chain.lower, chain.upper)
        z, found = solver.solve(
            seeds, target, lower=lower, upper=upper, weights=np.ones(chain.size), iterations=25
        )
        assert np.all((z >= lower) & (z <= upper))
        for at in (placement(chain, joint, local, row) for row in z[found]):
            assert np.linalg.norm(at.translation - target.translation) < 3e-6
            if kind == "upright":
                assert tilt(at, target) < 3e-6
            turned = max(turned, float(np.linalg.norm(pin.log3(target.rotation.T @ at.rotation))))
        solved += int(found.sum())
    assert solved > 0.7 * 30 * len(targets)
    assert turned > 0.3  # it makes use of the freedom


def test_what_hangs_upside_down_is_turned_upright() -> None:
    """A hand that points up is to point down: the gradient of a plain tilt vanishes there."""
    chain = consolidate(door_scene(), {})
    _, joint, local = solver_and_frame(chain)
    solver, (lower, upper) = (
        PoseSolver(chain.model, PoseRow(joint, local, (), "upright")),
        limits(chain),
    )
    start = np.concatenate([[0.0, 0.0, 0.0], chain.robot.home])
    here = placement(chain, joint, local, start)
    for axis in np.eye(3)[:2]:
        target = pin.SE3(pin.exp3(np.pi * axis) @ here.rotation, here.translation)
        assert tilt(here, target) == pytest.approx(np.pi, abs=1e-6)
        seeds = start + np.vstack(
            [np.zeros(chain.size), np.random.default_rng(9).uniform(-0.3, 0.3, (40, chain.size))]
        )
        residual, _ = solver.evaluate(seeds[:1], target)
        assert np.linalg.norm(residual[0, 3:]) > 1.0
        z, found = solver.solve(
            seeds, target, lower=lower, upper=upper, weights=np.ones(chain.size), iterations=60
        )
        assert found[0]
        assert found.mean() > 0.5
        for row in z[found]:
            at = placement(chain, joint, local, row)
            assert tilt(at, target) < 3e-6
            assert np.linalg.norm(at.translation - target.translation) < 3e-6


# --- short of a place, along a direction that another joint has
# -------------------------------------------------------


def test_residuals_and_jacobians_with_a_shift(chain: VirtualKinematicChain) -> None:
    """The shift is fixed in another joint's frame, such as a hand's approach direction."""
    _, joint, local = solver_and_frame(chain)
    hand, vector = chain.robot.model.njoints - 1, (0.03, -0.05, 0.08)
    z = random_configurations(chain.lower, chain.upper, 10, np.random.default_rng(10))
    target = placement(chain, joint, local, z[0])
    for kind in ("pose", "point", "upright"):
        solver = PoseSolver(chain.model, PoseRow(joint, local, (), kind, (hand, vector)))
        plain = PoseSolver(chain.model, PoseRow(joint, local, (), kind))
        residual, jacobian = solver.evaluate(z, target)
        shifted = np.array(
            [
                placement(chain, hand, pin.SE3.Identity(), row).rotation @ np.array(vector)
                for row in z
            ]
        )
        np.testing.assert_allclose(
            residual[:, :3], plain.evaluate(z, target)[0][:, :3] + shifted, rtol=0.0, atol=1e-9
        )
        np.testing.assert_allclose(
            residual[:, 3:], plain.evaluate(z, target)[0][:, 3:], rtol=0.0, atol=1e-9
        )
        change = 1e-6 * np.eye(chain.size)
        for row in range(10):
            ahead, behind = (
                solver.evaluate(z[row] + change, target)[0],
                solver.evaluate(z[row] - change, target)[0],
            )
            np.testing.assert_allclose(
                jacobian[row, :3], (ahead - behind).T[:3] / 2e-6, rtol=0.0, atol=1e-6
            )
        np.testing.assert_allclose(
            jacobian[:, 3:], plain.evaluate(z, target)[1][:, 3:], rtol=0.0, atol=1e-9
        )


def test_a_hand_that_is_short_of_its_goal_along_its_approach() -> None:
    chain = consolidate(door_scene(), {})
    _, joint, local = solver_and_frame(chain)
    goal = np.concatenate([[0.5, -0.3, 0.4], chain.robot.home])
    target = placement(chain, joint, local, goal)
    vector = 0.08 * local.rotation[:, 2]
    solver = PoseSolver(
        chain.model, PoseRow(joint, local, (), "pose", (joint, tuple(vector.tolist())))
    )
    seeds = goal + np.random.default_rng(11).uniform(-0.3, 0.3, (40, chain.size))
    lower, upper = limits(chain)
    z, found = solver.solve(
        seeds, target, lower=lower, upper=upper, weights=np.ones(chain.size), iterations=25
    )
    assert found.mean() > 0.8
    back = target * pin.SE3(np.eye(3), np.array([0.0, 0.0, -0.08]))
    assert np.all(errors(chain, joint, local, z[found], back) < 3e-6)
