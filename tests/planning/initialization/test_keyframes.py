"""Tests that keyframes are feasible by Pinocchio, within limits, and reproducible."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from helpers.small_problems import (
    SHORT,
    compute_grasp_error,
    load_door_scene,
)

import vkc_pin as vkc
from vkc_pin.planning.initialization.keyframes import (
    SAMPLE_COUNT,
    KeyframeCache,
    KeyframeSampler,
    compute_shortfall,
    sample_goal_configurations,
    sample_smoothstep,
)
from vkc_pin.utils.budget import Budget

OPEN = vkc.Actuate("door", {"hinge": 1.2})


@pytest.fixture(scope="module")
def problem() -> vkc.TrajectoryProblem:
    return vkc.build(load_door_scene(), [OPEN], options=SHORT)


def make_sampler(
    problem: vkc.TrajectoryProblem, seed: int = 0, cache: KeyframeCache | None = None
) -> KeyframeSampler:
    return KeyframeSampler(problem, np.random.default_rng(seed), cache)


def sample_grasps(sampler: KeyframeSampler, count: int = 64) -> np.ndarray:
    """Return random configurations with the hand at the handle."""
    start, grasp = sampler.problem.start, int(sampler.problem.ends[0])
    z, found = sampler.sample(np.tile(start, (count, 1)), grasp, "scatter")
    assert found.sum() > count // 8
    return z[found]


def test_profile_starts_and_ends_at_rest() -> None:
    s = np.concatenate([[0.0], sample_smoothstep(100)])
    assert s[-1] == 1.0
    assert (np.diff(s) > 0).all()
    np.testing.assert_allclose(s + s[::-1], 1.0)  # symmetric
    assert max(s[1], 1.0 - s[-2]) < 1e-3
    assert np.diff(s).max() == pytest.approx(1.5 / 100, rel=1e-3)
    np.testing.assert_array_equal(sample_smoothstep(1), [1.0])


def test_samples_hold_the_handle_at_every_waypoint(problem: vkc.TrajectoryProblem) -> None:
    sampler, grasp, steps = make_sampler(problem), int(problem.ends[0]), {}
    first = sample_grasps(sampler)
    columns = [problem.chain.index(f"door.{name}") for name in ("hinge", "knob")]
    for how, waypoint in itertools.product(
        ("scatter", "track", "shake"), (grasp, grasp + 1, problem.segments)
    ):
        z, found = sampler.sample(first, waypoint, how)
        assert found.any()
        joints = sampler.object_motion[waypoint - 1, columns]
        for row in z[found]:
            assert compute_grasp_error(load_door_scene(), row[:9], *joints) < 2e-4
        np.testing.assert_array_equal(z[:, columns], np.tile(joints, (len(z), 1)))
        lower, upper = (limits[waypoint - 1, 3:9] for limits in (problem.lower, problem.upper))
        assert np.all((z[found, 3:9] >= lower - 1e-9) & (z[found, 3:9] <= upper + 1e-9))
        steps[how, waypoint] = np.median(np.abs(z - first)[found, 3:9].max(axis=1))
    track, shake, scatter = (steps[how, grasp + 1] for how in ("track", "shake", "scatter"))
    assert track < shake < scatter


def test_cached_results_are_not_computed_again(problem: vkc.TrajectoryProblem) -> None:
    """The random generator continues as without a cache."""
    cache, grasp, start = KeyframeCache(), int(problem.ends[0]), np.tile(problem.start, (16, 1))
    results, used = [], []
    for kept in (None, cache, cache):
        sampler = make_sampler(problem, 3, kept)
        with Budget().activate() as budget:
            (z, found), (other, _) = (sampler.sample(start, grasp, "scatter") for _ in range(2))
            shortfalls = sampler.compute_shortfall(z, grasp)
            pushed = sampler.push_clear(z, grasp)
        results.append([z, found, other, shortfalls, pushed, sampler.rng.random(3)])
        used.append(budget.evaluations)
    assert used[0] == used[1] > used[2] == 0
    for values in zip(*results, strict=True):
        np.testing.assert_array_equal(values[0], values[1])
        np.testing.assert_array_equal(values[0], values[2])
    assert not np.array_equal(z, other)
    np.testing.assert_array_equal(sampler.compute_shortfall(z[::-1], grasp), shortfalls[::-1])
    assert not np.array_equal(make_sampler(problem, 4).sample(start, grasp, "scatter")[0], z)


def test_free_keyframes_satisfy_the_pose_constraint(problem: vkc.TrajectoryProblem) -> None:
    sampler, grasp = make_sampler(problem), int(problem.ends[0])
    z = sample_grasps(sampler)
    away = z + 0.01 * np.eye(problem.chain.size)[0]  # a centimetre from the handle
    assert (sampler.compute_shortfall(away, grasp) <= 0.0).any()
    assert not sampler.has_free_keyframe(grasp)
    is_free = sampler.compute_shortfall(z, grasp) <= 0.0
    assert sampler.has_free_keyframe(grasp)
    assert not sampler.has_free_keyframe(grasp + 1)
    other = make_sampler(problem)
    other.compute_shortfall(z[~is_free], grasp)
    assert not is_free.all()
    assert not other.has_free_keyframe(grasp)


def test_goal_configurations_report_their_residuals(problem: vkc.TrajectoryProblem) -> None:
    samples = sample_goal_configurations(problem, int(problem.ends[0]), np.random.default_rng(0))
    assert samples is not None
    z, residuals = samples
    assert z.shape == (SAMPLE_COUNT, problem.chain.size)
    errors = [compute_grasp_error(load_door_scene(), row[:9], 0.0, 0.0) for row in z]
    is_clear = (residuals <= 1e-5) | (residuals >= 1e-3)  # the measures agree for small angles
    np.testing.assert_array_equal((np.array(errors) < 3e-4)[is_clear], (residuals < 1e-4)[is_clear])
    assert (residuals < 1e-4).any()
    drive = vkc.build(load_door_scene(), [vkc.GoTo(0.3, 0.2)], options=SHORT)
    assert sample_goal_configurations(drive, 1, np.random.default_rng(0)) is None, "no goal there"


def test_weights_relate_lengths_to_angles() -> None:
    """Angles have weight 1, lengths the inverse lever of the hand, except in sliding grasps."""
    touch = vkc.Touch("stick.tip", (-1.0, 3.9, 0.1))
    free = vkc.build(vkc.load_scene("init_3"), [touch], options=SHORT)
    weights = dict(zip(free.chain.names, make_sampler(free).weights.tolist(), strict=True))
    assert weights["base_x"] == 1.0 / free.chain.robot.lever
    assert weights["base_yaw"] == weights["elbow_joint"] == 1.0
    grasp = {name: weight for name, weight in weights.items() if name.startswith("stick.grip")}
    assert "m" in {free.unit(name) for name in grasp}
    assert set(grasp.values()) == {1.0}


def test_pushing_frees_configurations_and_keeps_free_ones() -> None:
    """Most random configurations that touch the cube under the table collide."""
    scene = vkc.load_scene("init_1").with_held({"stick": "grip"}).with_start(base=[1.2, 1.0, 1.0])
    p = vkc.build(scene, [vkc.Touch("stick.tip", (-1.0, 3.897, 0.1))], options=SHORT)
    sampler, waypoint = make_sampler(p), p.segments

    def are_free(z: np.ndarray) -> np.ndarray:
        is_reached = sampler.compute_residual(z, 0) < 1e-4
        return np.asarray((compute_shortfall(p, z, waypoint) <= 0.0) & is_reached)

    z, found = sampler.sample(np.tile(p.start, (96, 1)), waypoint, "scatter")
    z = z[found]
    original, pushed = z.copy(), sampler.push_clear(z, waypoint)
    np.testing.assert_array_equal(z, original)
    assert np.count_nonzero(are_free(pushed)) >= np.count_nonzero(are_free(z)) + 5
    np.testing.assert_array_equal(pushed[are_free(z)], z[are_free(z)])
    assert np.all((pushed >= p.lower[-1] - 1e-12) & (pushed <= p.upper[-1] + 1e-12))
    again = sampler.push_clear(pushed, waypoint)
    np.testing.assert_allclose(again[are_free(pushed)], pushed[are_free(pushed)], atol=1e-4)
    assert np.abs(again - pushed)[~are_free(pushed)].max() > 1e-3
    heavy = make_sampler(p)
    heavy.weights[:3] *= 100.0  # of the base
    moved = [np.abs(one.push_clear(z, waypoint) - z)[:, :3].sum() for one in (sampler, heavy)]
    assert moved[1] < 0.5 * moved[0]
