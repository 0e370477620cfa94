"""Tests paths of base and arm by random trees in closed phases: a ball beside a moving door."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from helpers.drawers import replace_scene_fields
from helpers.small_problems import compute_grasp_error, load_door_scene, make_program

import vkc_pin as vkc
from vkc_pin.planning.initialization import keyframes
from vkc_pin.planning.initialization.approach_paths import ApproachPaths
from vkc_pin.planning.initialization.base_routes import BaseRoutes
from vkc_pin.planning.initialization.beam_search import BeamSearch
from vkc_pin.planning.initialization.closed_trees import (
    MAX_EXTENSIONS,
    find_closed_path,
    needs_trees,
)
from vkc_pin.planning.initialization.interpolation import Interpolator, RrtPaths
from vkc_pin.planning.initialization.keyframes import KeyframeSampler
from vkc_pin.utils.budget import Budget, BudgetExhaustedError

FEW = vkc.Options(reach_waypoints=20, turn_waypoints=6, move_waypoints=24)
OPEN_AND_LEAVE = [vkc.Actuate("door", {"hinge": 1.2}), vkc.GoTo(-1.0, 0.5)]
MOVE = 2  # the phase in which the door swings


def make_sampler(p: vkc.TrajectoryProblem, seed: int = 0) -> KeyframeSampler:
    return KeyframeSampler(p, np.random.default_rng(seed))


@cache
def make_free_door() -> tuple[vkc.TrajectoryProblem, np.ndarray, list[int], np.ndarray]:
    """Return the door problem, keyframes with their waypoints, and straight waypoints."""
    p = make_program(load_door_scene(), OPEN_AND_LEAVE, options=FEW)
    sampler = make_sampler(p, 2)
    found = BeamSearch(sampler).search(thorough=True)
    path = found.paths[int(np.argmin(np.where(found.collision_cost == 0.0, found.cost, np.inf)))]
    z = Interpolator(sampler, ApproachPaths(sampler), None).interpolate(path, found.waypoints)
    assert z is not None
    return p, path, found.waypoints, z


def get_move_phase() -> tuple[np.ndarray, np.ndarray]:
    """Return the keyframes and the straight waypoints of phase MOVE."""
    p, path, waypoints, z = make_free_door()
    begin, end = int(p.ends[MOVE - 1]), int(p.ends[MOVE])
    is_within = [begin <= at <= end for at in waypoints]
    return path[is_within], z[begin:end]


@cache
def make_blocked_door() -> vkc.TrajectoryProblem:
    """Return the same problem with a ball in the elbow's path."""
    p, straight = make_free_door()[0], get_move_phase()[1]
    _, places = p.chain.joint_placements(straight[len(straight) // 2][None])
    scene = load_door_scene()
    elbow = p.chain.model.getJointId(str(scene.robot.model.names[4]))
    position = places[0, elbow].round(4).tolist()
    ball = {"name": "ball", "type": "sphere", "radius": 0.06, "position": position}
    obstacles = [*scene.document["obstacles"], ball]
    blocked = replace_scene_fields(scene, obstacles=obstacles)
    return make_program(blocked, OPEN_AND_LEAVE, options=FEW)


def find_path_with_door(seed: int, *, max_extensions: int = MAX_EXTENSIONS) -> np.ndarray | None:
    through, straight = get_move_phase()
    sampler = make_sampler(make_blocked_door(), seed)
    return find_closed_path(sampler, MOVE, through, len(straight), max_extensions)


def compute_penetration(p: vkc.TrajectoryProblem, rows: np.ndarray) -> float:
    short = keyframes.compute_shortfall(p, rows, p.contacts.find_waypoint(MOVE), reach=0.0)
    return float(short.max() - p.options.dist_safe)


def assert_holds_the_handle(p: vkc.TrajectoryProblem, rows: np.ndarray) -> None:
    hinge, knob = (p.chain.index(f"door.{name}") for name in ("hinge", "knob"))
    for row in rows:
        assert compute_grasp_error(load_door_scene(), row, row[hinge], row[knob]) < 1e-3


@pytest.mark.parametrize("seed", range(2))
def test_path_avoids_an_obstacle_and_holds_the_handle(seed: int) -> None:
    p, (through, straight) = make_free_door()[0], get_move_phase()
    assert compute_penetration(make_blocked_door(), straight) > 0.02
    rows = find_path_with_door(seed)
    assert rows is not None
    assert rows.shape == straight.shape
    assert compute_penetration(make_blocked_door(), rows) <= 5e-3  # waypoints are between nodes
    assert_holds_the_handle(p, rows)
    hinge = rows[:, p.chain.index("door.hinge")]
    assert hinge[-1] == pytest.approx(1.2)
    assert np.all((hinge >= -1e-9) & (hinge <= 1.2 + 1e-9))
    lower, upper = p.lower[p.ends[MOVE] - 1], p.upper[p.ends[MOVE] - 1]
    assert np.all(((rows >= lower - 1e-9) & (rows <= upper + 1e-9))[:, :9])
    steps = np.abs(np.diff(np.vstack([through[0], rows]), axis=0)).max(axis=1)
    assert steps[0] < 0.1
    assert steps.max() < 0.6
    if seed == 1:
        np.testing.assert_array_equal(find_path_with_door(seed), rows)


def test_next_phase_begins_where_the_closed_path_ends() -> None:
    p, (_, path, waypoints, _) = make_blocked_door(), make_free_door()
    sampler = make_sampler(p)
    approach = ApproachPaths(sampler, keeps_base_fixed=True)
    paths = RrtPaths(sampler, BaseRoutes(p))
    z = Interpolator(sampler, approach, paths).interpolate(path, waypoints)
    assert z is not None
    begin, end = int(p.ends[MOVE - 1]), int(p.ends[MOVE])
    assert compute_penetration(p, z[begin:end]) <= 5e-3
    assert_holds_the_handle(p, z[int(p.ends[0]) - 1 : end])
    assert z[-1, p.chain.index("door.hinge")] == pytest.approx(1.2)
    assert np.abs(np.diff(z, axis=0))[:, 3:9].max() < 1.0


def test_closed_path_stays_within_the_limits_of_the_object() -> None:
    """Nodes between two waypoints may exceed those of both."""
    p = make_blocked_door()
    inside, hinge = slice(int(p.ends[MOVE - 1]), int(p.ends[MOVE]) - 1), p.chain.index("door.hinge")
    upper = p.upper.copy()
    upper[inside, hinge] = 1.0
    sampler = make_sampler(p.with_bounds(p.lower, upper))
    approach = ApproachPaths(sampler, keeps_base_fixed=True)
    paths = RrtPaths(sampler, BaseRoutes(sampler.problem))
    z = Interpolator(sampler, approach, paths).interpolate(*make_free_door()[1:3])
    assert z is not None
    assert z[inside, hinge].max() == 1.0
    assert_holds_the_handle(p, z[inside])


def test_free_phases_and_colliding_starts_need_no_trees() -> None:
    p, (through, straight) = make_free_door()[0], get_move_phase()
    assert compute_penetration(p, straight) <= 0.0
    assert not needs_trees(make_sampler(p), MOVE, through, straight)
    assert needs_trees(make_sampler(make_blocked_door()), MOVE, through, straight)
    colliding = through.copy()
    colliding[0] = straight[len(straight) // 2]
    assert not needs_trees(make_sampler(make_blocked_door()), MOVE, colliding, straight)


def test_extensions_and_budget_end_the_search() -> None:
    assert find_path_with_door(0, max_extensions=0) is None
    with Budget(max_evaluations=50).activate(), pytest.raises(BudgetExhaustedError):
        find_path_with_door(0)
