"""Tests of moving configurations out of collision while their pose constraint stays satisfied."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from helpers.small_problems import program_of

import vkc_pin as vkc
from vkc_pin.planning.initialization.collision_recovery import resolve_collisions
from vkc_pin.planning.initialization.keyframes import KeyframeSampler


@dataclass
class Samples:
    """Random configurations, shape (B, n), that touch the cube under the table; most collide."""

    problem: vkc.TrajectoryProblem
    sampler: KeyframeSampler
    z: np.ndarray

    def resolve(self, **changes: Any) -> np.ndarray:
        solver, target = self.sampler.get_pose_solver(0)
        lower, upper = (
            np.tile(limits[-1], (len(self.z), 1))
            for limits in (self.problem.lower, self.problem.upper)
        )
        how = {"lower": lower, "upper": upper, "weights": self.sampler.weights, **changes}
        return resolve_collisions(
            self.problem, self.z, self.problem.segments, solver, target, **how
        )

    def are_free(self) -> np.ndarray:
        """Return which configurations are free and feasible, shape (B,)."""
        solver, target = self.sampler.get_pose_solver(0)
        residual, _ = solver.evaluate(self.z, target)
        return (self.sampler.compute_shortfall(self.z, self.problem.segments) <= 0.0) & (
            np.abs(residual).max(axis=1) < 1e-4
        )


@pytest.fixture(scope="module")
def samples() -> Samples:
    scene = vkc.load_scene("init_1").with_held({"stick": "grip"}).with_start(base=[1.2, 1.0, 1.0])
    problem = program_of(scene, [vkc.Touch("stick.tip", (-1.0, 3.897, 0.1))])
    sampler = KeyframeSampler(problem, np.random.default_rng(0))
    z, found = sampler.sample(np.tile(problem.start, (96, 1)), problem.segments, "scatter")
    return Samples(problem, sampler, z[found])


@pytest.fixture(scope="module")
def pushed(samples: Samples) -> Samples:
    z = samples.sampler.push_clear(samples.z, samples.problem.segments)
    return dataclasses.replace(samples, z=z)


def test_pushing_frees_many_configurations(samples: Samples, pushed: Samples) -> None:
    problem = samples.problem
    assert np.count_nonzero(pushed.are_free()) >= np.count_nonzero(samples.are_free()) + 5
    assert np.all(pushed.z >= problem.lower[-1] - 1e-12)
    assert np.all(pushed.z <= problem.upper[-1] + 1e-12)


def test_free_configurations_stay_unchanged(pushed: Samples) -> None:
    is_free, given = pushed.are_free(), pushed.z.copy()
    again = pushed.resolve()
    np.testing.assert_array_equal(again[is_free], given[is_free])
    assert np.abs(again - given)[~is_free].max() > 1e-3
    np.testing.assert_array_equal(pushed.z, given)


def test_limits_are_kept(samples: Samples) -> None:
    z = samples.z
    lower, upper = z - 0.02, z + 0.03
    moved = samples.resolve(lower=lower, upper=upper)
    assert np.all((moved >= lower) & (moved <= upper))
    assert np.any(moved == lower)
    assert np.any(moved == upper)
    lower, upper = z - 0.5, z + 0.5
    lower[:, 3:5] = upper[:, 3:5] = z[:, 3:5]
    moved = samples.resolve(lower=lower, upper=upper)
    np.testing.assert_array_equal(moved[:, 3:5], z[:, 3:5])
    assert np.abs(moved - z).max() > 0.1


def test_larger_weights_move_less(samples: Samples) -> None:
    even = np.ones(samples.problem.chain.size)
    heavy = even.copy()
    heavy[:3] = 100.0
    moved = [
        np.abs(samples.resolve(weights=each) - samples.z)[:, :3].sum() for each in (even, heavy)
    ]
    assert moved[1] < 0.5 * moved[0]
