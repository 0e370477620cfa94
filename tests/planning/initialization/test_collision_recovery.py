from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.small_problems import door_scene, program_of
from helpers.telescopes import coupled_scene

import vkc_pin as vkc
from vkc_pin.planning.chain.inverse_kinematics import MAX_STEP
from vkc_pin.planning.initialization import collision_recovery as clearing
from vkc_pin.planning.initialization.collision_recovery import resolve_collisions
from vkc_pin.planning.initialization.keyframes import KeyframeCache, KeyframeSampler


def drawn(
    steps: list[vkc.Grasp | vkc.Actuate | vkc.Touch], scene: vkc.Scene
) -> tuple[vkc.TrajectoryProblem, KeyframeSampler]:
    problem = program_of(scene, steps)
    return problem, KeyframeSampler(problem, np.random.default_rng(0))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("coupled", [False, True])
def test_point_jacobians_match_finite_differences(seed: int, coupled: bool, tmp_path: Path) -> None:
    """Jacobians equal differences of Pinocchio's placements for every joint of a chain.

    Or a drawer, held by a robot whose joints follow others.
    """
    held, scene = (
        ({"drawer": "grip"}, coupled_scene(tmp_path))
        if coupled
        else ({"door": "handle_free"}, door_scene())
    )
    chain = vkc.consolidate(scene, held)
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

    jacobian = chain.point_jacobians(z, which, joints, points(z))
    assert jacobian.shape == (len(joints), 3, chain.size)
    for column in range(chain.size):
        change = np.zeros_like(z)
        change[:, column] = step
        differences = (points(z + change) - points(z - change)) / (2 * step)
        np.testing.assert_allclose(jacobian[:, :, column], differences, atol=1e-7)


def test_pushed_configurations_are_free_and_feasible() -> None:
    """Most random configurations collide; pushing frees many more."""
    scene = vkc.load_scene("init_1").with_held({"stick": "grip"}).with_start(base=[1.2, 1.0, 1.0])
    problem, sampler = drawn([vkc.Touch("stick.tip", (-1.0, 3.897, 0.1))], scene)
    waypoint = problem.segments
    z, found = sampler.sample(np.tile(problem.start, (96, 1)), waypoint, "scatter")
    z = z[found]
    before = sampler.compute_shortfall(z, waypoint)
    pushed = sampler.push_clear(z, waypoint)
    after = sampler.compute_shortfall(pushed, waypoint)
    assert np.count_nonzero(after <= 0.0) >= np.count_nonzero(before <= 0.0) + 5
    residual, _ = problem.transcription.pose_solvers[0].evaluate(
        pushed[after <= 0.0], problem.targets[0]
    )
    assert np.abs(residual).max() < 1e-3
    assert np.all(pushed >= problem.lower[-1] - 1e-12)
    assert np.all(pushed <= problem.upper[-1] + 1e-12)


def test_free_configurations_hardly_move() -> None:
    problem, sampler = drawn([vkc.Grasp("door")], door_scene())
    z, found = sampler.sample(np.tile(problem.start, (96, 1)), problem.segments, "scatter")
    free = z[found][sampler.compute_shortfall(z[found], problem.segments) <= 0.0]
    assert len(free) > 3
    np.testing.assert_allclose(sampler.push_clear(free, problem.segments), free, atol=0.05)


@dataclass
class Scattered:
    """Random configurations that touch the cube under the table, most of them in collision.

    Attributes:
        problem, knots: Where they come from.
        z: Shape (B, n).
    """

    problem: vkc.TrajectoryProblem
    sampler: KeyframeSampler
    z: np.ndarray

    def cleared(self, **changes: Any) -> np.ndarray:
        """Return the pushed configurations, with other arguments."""
        solver, target = self.sampler.get_pose_solver(0)
        lower, upper = (
            np.tile(limits[-1], (len(self.z), 1))
            for limits in (self.problem.lower, self.problem.upper)
        )
        fields = {"lower": lower, "upper": upper, "weights": self.sampler.weights, **changes}
        return resolve_collisions(
            self.problem, self.z, self.problem.segments, solver, target, **fields
        )

    def free(self) -> np.ndarray:
        """Return which configurations are free and feasible, shape (B,)."""
        solver, target = self.sampler.get_pose_solver(0)
        residual, _ = solver.evaluate(self.z, target)
        return (self.sampler.compute_shortfall(self.z, self.problem.segments) <= 0.0) & (
            np.abs(residual).max(axis=1) < 1e-4
        )


@pytest.fixture(scope="module")
def scattered() -> Scattered:
    scene = vkc.load_scene("init_1").with_held({"stick": "grip"}).with_start(base=[1.2, 1.0, 1.0])
    problem, sampler = drawn([vkc.Touch("stick.tip", (-1.0, 3.897, 0.1))], scene)
    z, found = sampler.sample(np.tile(problem.start, (96, 1)), problem.segments, "scatter")
    return Scattered(problem, sampler, z[found])


@pytest.fixture(scope="module")
def cleared(scattered: Scattered) -> Scattered:
    return dataclasses.replace(
        scattered, z=scattered.sampler.push_clear(scattered.z, scattered.problem.segments)
    )


def test_free_configurations_stay_unchanged(cleared: Scattered) -> None:
    free, given = cleared.free(), cleared.z.copy()
    assert np.count_nonzero(free) > 5
    pushed = cleared.cleared()
    np.testing.assert_array_equal(pushed[free], given[free])
    assert np.abs(pushed - given)[~free].max() > 1e-3
    np.testing.assert_array_equal(cleared.z, given)  # what comes out is a copy


def test_limits_are_kept(scattered: Scattered) -> None:
    z = scattered.z
    pushed = scattered.cleared(lower=z - 0.02, upper=z + 0.03)
    assert np.all((pushed >= z - 0.02) & (pushed <= z + 0.03))
    assert np.any(pushed == z - 0.02)
    assert np.any(pushed == z + 0.03)
    upper = z + 0.5
    upper[:, 3:5] = z[:, 3:5]
    lower = z - 0.5
    lower[:, 3:5] = z[:, 3:5]
    pushed = scattered.cleared(lower=lower, upper=upper)
    np.testing.assert_array_equal(pushed[:, 3:5], z[:, 3:5])
    assert np.abs(pushed - z).max() > 0.1


def test_steps_are_limited_to_the_linear_range(
    scattered: Scattered, cleared: Scattered, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clearing, "_CLEARING_ROUNDS", 1)
    far, near = (np.abs(some.cleared() - some.z).max(axis=1) for some in (scattered, cleared))
    assert far.max() == pytest.approx(MAX_STEP)
    assert np.any((near > 0.0) & (near < 0.5 * MAX_STEP))  # short steps stay as they are


def test_larger_weights_move_less(scattered: Scattered, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clearing, "_CLEARING_ROUNDS", 1)
    even = np.ones(scattered.problem.chain.size)
    heavy = even.copy()
    heavy[:3] = 100.0
    moved = [
        np.abs(scattered.cleared(weights=weights) - scattered.z)[:, :3].sum()
        for weights in (even, heavy)
    ]
    assert moved[1] < 0.5 * moved[0]


def test_shared_caches_do_not_change_searches(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = program_of(door_scene(), [vkc.Grasp("door", "handle_free")])
    known, waypoint = KeyframeCache(), int(problem.ends[0])
    before = np.tile(problem.start, (8, 1))

    def found(sampler: KeyframeSampler) -> list[np.ndarray]:
        drawn = [sampler.sample(before, waypoint, "scatter") for _ in range(2)]
        z = np.concatenate([z for z, _ in drawn])
        return [
            z,
            np.concatenate([ok for _, ok in drawn]),
            sampler.compute_shortfall(z, waypoint),
            sampler.push_clear(z, waypoint),
            sampler.rng.random(3),
        ]

    alone, first = (
        found(KeyframeSampler(problem, np.random.default_rng(0))),
        found(KeyframeSampler(problem, np.random.default_rng(0), known)),
    )

    def refuse(*_args: Any, **_kwargs: Any) -> None:
        raise AssertionError("asked again")

    for name in ("compute_shortfall", "resolve_collisions"):
        monkeypatch.setattr(f"vkc_pin.planning.initialization.keyframes.{name}", refuse)
    again = found(KeyframeSampler(problem, np.random.default_rng(0), known))
    assert not np.array_equal(alone[0][:8], alone[0][8:])
    for one, other, third in zip(alone, first, again, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)
        np.testing.assert_array_equal(other, third)
