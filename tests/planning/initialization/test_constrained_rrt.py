"""Tests of constrained RRT around an obstacle, with a door that may wait."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from helpers.small_problems import door_scene, hand_off_the_handle, program_of

import vkc_pin as vkc
from vkc_pin.planning.initialization import constrained_rrt as held
from vkc_pin.planning.initialization.beam_search import BeamSearch
from vkc_pin.planning.initialization.constrained_rrt import find_constrained_path, is_obstructed
from vkc_pin.planning.initialization.interpolation import Interpolator
from vkc_pin.planning.initialization.keyframes import KeyframeSampler, compute_shortfall
from vkc_pin.planning.initialization.rrt import MAX_EXTENSIONS, STEP
from vkc_pin.utils.budget import Budget, BudgetExhaustedError
from vkc_pin.world.scene.scene import Scene

FEW = vkc.Options(reach_waypoints=20, turn_waypoints=6, move_waypoints=24)
OPEN = vkc.Actuate("door", {"hinge": 1.2})
MOVE = 2  # the phase in which the door swings
RADIUS = 0.06  # [m] of the ball


@cache
def free_door() -> tuple[vkc.TrajectoryProblem, np.ndarray, np.ndarray]:
    """Return the door problem, keyframes of its last phase, and straight waypoints."""
    p = program_of(door_scene(), [OPEN], options=FEW)
    sampler = KeyframeSampler(p, np.random.default_rng(0))
    found = BeamSearch(sampler).search(thorough=True)
    best = int(np.argmin(np.where(found.collision_cost == 0.0, found.cost, np.inf)))
    begin = int(p.ends[MOVE - 1])
    inside = [k for k, waypoint in enumerate(found.waypoints) if waypoint >= begin]
    through, steps = found.paths[best, inside], p.segments - begin
    straight = np.empty((steps, p.chain.size))
    Interpolator(sampler, None, None)._fill_straight(
        straight, through, [found.waypoints[k] - begin for k in inside]
    )  # type: ignore[arg-type]
    return p, through, straight


@cache
def blocked() -> vkc.TrajectoryProblem:
    """Return the same problem with a ball in the elbow's path."""
    p, _, straight = free_door()
    robot = door_scene().robot
    _, places = p.chain.joint_placements(straight[len(straight) // 2][None])
    elbow = p.chain.model.getJointId(str(robot.model.names[4]))
    ball = {
        "name": "ball",
        "type": "sphere",
        "radius": RADIUS,
        "position": places[0, elbow].round(4).tolist(),
    }
    document = door_scene().document
    scene = Scene.from_document(
        {**document, "obstacles": [*document.get("obstacles", []), ball]}, door_scene().folder
    )
    return program_of(scene, [OPEN], options=FEW)


def search(seed: int, *, tries: int = MAX_EXTENSIONS) -> np.ndarray | None:
    _, through, straight = free_door()
    return find_constrained_path(
        KeyframeSampler(blocked(), np.random.default_rng(seed)), MOVE, through, len(straight), tries
    )


def penetration(p: vkc.TrajectoryProblem, rows: np.ndarray) -> float:
    return float(
        (
            compute_shortfall(p, rows, p.contacts.find_waypoint(MOVE), reach=0.0)
            - p.options.dist_safe
        ).max()
    )


@pytest.mark.parametrize("seed", range(3))
def test_path_avoids_an_obstacle_and_holds_the_handle(seed: int) -> None:
    p, through, straight = free_door()
    assert penetration(blocked(), straight) > 0.02, "the ball is not in the way"
    rows = search(seed)
    assert rows is not None
    assert rows.shape == straight.shape
    assert penetration(blocked(), rows) <= 5e-3  # waypoints are between nodes
    hinge, knob = (p.chain.index(f"door.{name}") for name in ("hinge", "knob"))
    for row in rows:
        assert hand_off_the_handle(door_scene(), row, row[hinge], row[knob]) < 1e-3
    assert rows[-1, hinge] == pytest.approx(1.2)
    lower, upper = p.lower[-1], p.upper[-1]
    assert np.all((rows >= lower - 1e-9)[:, :9])
    assert np.all((rows <= upper + 1e-9)[:, :9])
    steps = np.abs(np.diff(np.vstack([through[0], rows]), axis=0)).max(axis=1)
    assert steps[0] < 0.1
    assert steps.max() < 0.6


def test_free_phases_and_colliding_starts_are_not_obstructed() -> None:
    p, through, straight = free_door()
    assert penetration(p, straight) <= 0.0
    assert not is_obstructed(KeyframeSampler(p, np.random.default_rng(0)), MOVE, through, straight)
    sampler, inside = KeyframeSampler(blocked(), np.random.default_rng(0)), through.copy()
    assert is_obstructed(sampler, MOVE, through, straight)
    inside[0] = straight[len(straight) // 2]
    assert not is_obstructed(sampler, MOVE, inside, straight), "no tree leads out of things"


def test_no_path_without_extensions() -> None:
    assert search(0, tries=0) is None


def test_equal_random_seeds_give_equal_paths() -> None:
    one, same, other = search(3), search(3), search(4)
    np.testing.assert_array_equal(one, same)
    assert one is not None
    assert other is None or not np.array_equal(one, other)


def test_a_budget_ends_the_search() -> None:
    with Budget(effort=50).activate(), pytest.raises(BudgetExhaustedError):
        search(0)


def finder(p: vkc.TrajectoryProblem, seed: int = 0) -> held._Search:
    return held._Search(
        KeyframeSampler(p, np.random.default_rng(seed)), MOVE, p.segments - int(p.ends[MOVE - 1])
    )


def test_door_position_is_interpolated_between_waypoints() -> None:
    p, through, _ = free_door()
    own, hinge = finder(p), p.chain.index("door.hinge")
    at = np.array([own.begin, own.begin + 7.0, own.begin + 7.25, own.begin + 8.0, own.end])
    z, closed = own.project(np.tile(through[2], (5, 1)), at)
    angles = own.sampler.object_motion[:, hinge]
    whole = [
        0.0,
        angles[own.begin + 6],
        angles[own.begin + 6] * 0.75 + angles[own.begin + 7] * 0.25,
        angles[own.begin + 7],
        1.2,
    ]
    np.testing.assert_allclose(z[:, hinge], whole, atol=1e-12)
    for row in z[closed]:
        assert (
            hand_off_the_handle(door_scene(), row, row[hinge], row[p.chain.index("door.knob")])
            < 1e-3
        )
    assert closed[1:4].any()


def test_shortcuts_do_not_lengthen_a_path_and_keep_its_ends() -> None:
    _, through, _ = free_door()
    own = finder(blocked(), 5)
    path = own.run(through, MAX_EXTENSIONS)
    assert path is not None
    short = own.shorten(path)
    before, after = (
        float(own.compute_distances(each.z[1:], each.z[:-1]).sum()) for each in (path, short)
    )
    assert after < before
    for each in (path, short):
        np.testing.assert_array_equal(each.z[0], through[0])
        assert (each.at[0], each.at[-1]) == (own.begin, own.end)
        assert own.compute_distances(each.z[1:], each.z[:-1]).max() <= 2.0 * STEP + 1e-9
        assert own.are_free(each.z).all()
    np.testing.assert_array_equal(short.z[-1], path.z[-1])


@pytest.mark.parametrize("out", [False, True])
def test_path_without_closure_gives_no_waypoints(
    out: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The base must be where the arm cannot reach the handle."""
    _, through, _ = free_door()
    own = finder(blocked(), 5)
    path = own.run(through, MAX_EXTENSIONS)
    assert path is not None
    limits = own.sampler.compute_limits

    def beyond(z: np.ndarray, waypoint: int) -> tuple[np.ndarray, np.ndarray]:
        lower, upper = limits(z, waypoint)
        lower[:, 0] = upper[:, 0] = -3.0
        return lower, upper

    if out:
        monkeypatch.setattr(own.sampler, "compute_limits", beyond)
    assert (own.resample(path, own.end - own.begin) is None) == out


def test_samples_keep_the_grasp(monkeypatch: pytest.MonkeyPatch) -> None:
    """Samples must keep the grasp; here the base's x stands for it, so none does."""
    p, through, _ = free_door()
    assert len(finder(p).sample_free(through, finder(p).end)) > 0
    monkeypatch.setattr(KeyframeSampler, "find_grasp_columns", lambda self, waypoint: [0])
    own = finder(p)
    assert len(own.sample_free(through, own.end)) == 0
    z, closed = own.project(through[1:] + 0.01, np.full(len(through) - 1, own.end))
    assert closed.any()
    np.testing.assert_array_equal(z[:, 0], through[1:, 0] + 0.01)
