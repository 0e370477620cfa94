"""Checks solutions of inverse kinematics with numeric Pinocchio."""

from __future__ import annotations

from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from helpers.small_problems import load_door_scene, make_full_scene, sample_configurations

from vkc_pin.planning.chain.chain import VirtualKinematicChain, consolidate
from vkc_pin.planning.chain.inverse_kinematics import PoseSolver
from vkc_pin.planning.chain.pose import PoseRow

Shift = tuple[int, tuple[float, float, float]]
KINDS = ("pose", "point", "upright")


@pytest.fixture(scope="module", params=[{}, {"cabinet": "ball"}], ids=["robot", "ball"])
def chain(request: pytest.FixtureRequest) -> VirtualKinematicChain:
    return consolidate(make_full_scene(), request.param)


@pytest.fixture(scope="module")
def robot() -> VirtualKinematicChain:
    return consolidate(load_door_scene(), {})


def get_last_frame(chain: VirtualKinematicChain) -> tuple[int, pin.SE3]:
    """Return joint and local placement of the grasped object's base, or else of the tool."""
    if chain.closures:
        (closure,) = chain.closures.values()
        return closure.joint, closure.local
    return chain.frame(chain.robot.tool_frame)


@cache
def make_solver(
    chain: VirtualKinematicChain, kind: str = "pose", shift: Shift | None = None
) -> PoseSolver:
    joint, local = get_last_frame(chain)
    return PoseSolver(chain.tree, PoseRow(joint, (), kind, shift), local, chain.cache)


def compute_placement(
    chain: VirtualKinematicChain, z: np.ndarray, frame: tuple[int, pin.SE3] | None = None
) -> pin.SE3:
    joint, local = frame or get_last_frame(chain)
    data = chain.model.createData()
    pin.forwardKinematics(chain.model, data, chain.coordinates.q(z))
    return data.oMi[joint] * local


def compute_angle(kind: str, placement: pin.SE3, target: pin.SE3) -> float:
    """Return the angle [rad] to the goal; of verticals, if it may turn about the vertical."""
    if kind == "pose":
        return float(np.linalg.norm(pin.log3(target.rotation.T @ placement.rotation)))
    vertical = target.rotation.T @ np.array([0.0, 0.0, 1.0])
    tilt = float(np.arccos(np.clip((placement.rotation @ vertical)[2], -1.0, 1.0)))
    return tilt if kind != "point" else 0.0


def solve(
    chain: VirtualKinematicChain,
    guesses: np.ndarray,
    target: pin.SE3,
    kind: str = "pose",
    *,
    lower: np.ndarray | None = None,
    upper: np.ndarray | None = None,
    weights: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return solutions and their mask, checked against limits and target."""
    limits = get_limits(chain)
    lower, upper = limits[0] if lower is None else lower, limits[1] if upper is None else upper
    weights = np.ones(chain.size) if weights is None else weights
    solver = make_solver(chain, kind)
    z, found = solver.solve(
        guesses, target, lower=lower, upper=upper, weights=weights, iterations=40
    )
    assert z.shape == guesses.shape
    assert np.isfinite(z).all()
    assert ((z >= lower) & (z <= upper)).all()
    placements = [compute_placement(chain, row) for row in z]
    distances = [np.linalg.norm(at.translation - target.translation) for at in placements]
    errors = np.maximum(distances, [compute_angle(kind, at, target) for at in placements])
    assert (errors[found] < 3e-6).all()  # each residual is below 1e-6
    assert (errors[~found] > 5e-7).all()
    return z, found


def get_limits(chain: VirtualKinematicChain) -> tuple[np.ndarray, np.ndarray]:
    lower, upper = chain.lower.copy(), chain.upper.copy()
    lower[:2], upper[:2] = -3.0, 3.0
    return lower, upper


def make_home(chain: VirtualKinematicChain, *base: float) -> np.ndarray:
    return np.concatenate([base or [0.0, 0.0, 0.0], chain.robot.home])


@pytest.mark.parametrize("kind", [*KINDS, "level"])
@pytest.mark.parametrize("shifted", [False, True])
def test_residuals_equal_definitions_and_jacobians_equal_differences(
    chain: VirtualKinematicChain, kind: str, shifted: bool
) -> None:
    """A shift is fixed in another joint's frame, such as a hand's approach direction."""
    hand, vector = chain.robot.model.njoints - 1, (0.03, -0.05, 0.08)
    solver = make_solver(chain, kind, (hand, vector) if shifted else None)
    z = sample_configurations(chain.lower, chain.upper, 5, np.random.default_rng(0))
    target = compute_placement(chain, z[0])
    residual, jacobian = solver.evaluate(z, target)
    for row in range(5):
        at = compute_placement(chain, z[row])
        offset = at.translation - target.translation
        if shifted:
            frame = (hand, pin.SE3.Identity())
            offset = offset + compute_placement(chain, z[row], frame).rotation @ np.array(vector)
        chord = 2 * np.sin(compute_angle(kind, at, target) / 2)
        angular = residual[row, 0 if kind == "level" else 3 :]
        assert np.linalg.norm(angular) == pytest.approx(chord, abs=1e-7)
        if kind != "level":
            np.testing.assert_allclose(residual[row, :3], offset, rtol=0.0, atol=1e-9)
        changes = 1e-6 * np.eye(chain.size)
        ahead, behind = (
            solver.evaluate(z[row] + change, target)[0] for change in (changes, -changes)
        )
        np.testing.assert_allclose(jacobian[row], (ahead - behind).T / 2e-6, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_solutions_attain_the_goal_within_limits(chain: VirtualKinematicChain, kind: str) -> None:
    rng, turned, solved = np.random.default_rng(1), 0.0, []
    for row in sample_configurations(chain.lower, chain.upper, 4, rng, arena=1.0):
        target = compute_placement(chain, row)
        guesses = np.clip(row + rng.uniform(-0.6, 0.6, (30, chain.size)), chain.lower, chain.upper)
        z, found = solve(chain, guesses, target, kind)
        solved.append(found.mean())
        rotations = [compute_placement(chain, one).rotation for one in z[found]]
        turned = max(turned, *(np.linalg.norm(pin.log3(target.rotation.T @ r)) for r in rotations))
    assert np.mean(solved) > 0.7
    assert (turned > 0.3) == (kind != "pose")  # freedoms are used


def test_guesses_at_the_goal_are_not_changed(chain: VirtualKinematicChain) -> None:
    z = sample_configurations(chain.lower, chain.upper, 1, np.random.default_rng(2))
    same, found = solve(chain, z, compute_placement(chain, z[0]))
    assert found.all()
    np.testing.assert_array_equal(same, z)


def test_equal_limits_fix_coordinates(robot: VirtualKinematicChain) -> None:
    goal, rng = make_home(robot, 0.5, -0.3, 0.4), np.random.default_rng(4)
    target = compute_placement(robot, goal)
    guesses = goal + rng.uniform(-0.3, 0.3, (40, robot.size))
    lower, upper = get_limits(robot)
    lower[5] = upper[5] = goal[5]
    _, found = solve(robot, guesses, target, lower=lower, upper=upper)
    assert found.mean() > 0.8
    lower, upper = (np.tile(side, (40, 1)) for side in get_limits(robot))  # one row per guess
    lower[:, 2] = upper[:, 2] = guesses[:, 2]
    _, found = solve(robot, guesses, target, lower=lower, upper=upper)
    assert found.mean() > 0.8


def test_goal_is_attained_despite_an_active_limit(robot: VirtualKinematicChain) -> None:
    goal, rng = make_home(robot), np.random.default_rng(5)
    guesses = goal + rng.uniform(-0.1, 0.1, (40, robot.size))
    guesses[:, 0] = -0.2 - rng.uniform(0.0, 0.03, 40)
    upper = get_limits(robot)[1]
    farthest = []
    for upper[0] in (3.0, -0.2):
        z, found = solve(robot, guesses, compute_placement(robot, goal), upper=upper)
        assert found.mean() > 0.8
        farthest.append(z[found, 0].max())
    assert farthest[0] > -0.15


def test_coordinates_of_large_weight_move_less(robot: VirtualKinematicChain) -> None:
    goal = make_home(robot)
    guesses = goal + np.random.default_rng(6).uniform(-0.2, 0.2, (60, robot.size))
    travel = []
    for weight in (0.1, 100.0):
        weights = np.concatenate([np.full(3, weight), np.ones(robot.size - 3)])
        z, found = solve(robot, guesses, compute_placement(robot, goal), weights=weights)
        assert found.mean() > 0.8
        travel.append(np.abs(z - guesses)[found, :3].sum(axis=1).mean())
    assert travel[1] < 0.3 * travel[0]


@pytest.mark.parametrize("axis", range(2))
def test_upside_down_frames_are_turned_upright(robot: VirtualKinematicChain, axis: int) -> None:
    """The gradient of the tilt angle vanishes at half turns."""
    start = make_home(robot)
    here = compute_placement(robot, start)
    target = pin.SE3(pin.exp3(np.pi * np.eye(3)[axis]) @ here.rotation, here.translation)
    assert compute_angle("upright", here, target) == pytest.approx(np.pi, abs=1e-6)
    others = np.random.default_rng(9).uniform(-0.3, 0.3, (40, robot.size))
    guesses = start + np.vstack([np.zeros(robot.size), others])
    _, found = solve(robot, guesses, target, "upright")
    assert found[0]
    assert found.mean() > 0.5
