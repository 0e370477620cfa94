"""Tests approach and retreat paths with a moving and a fixed base."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from helpers.small_problems import load_door_scene, make_program

import vkc_pin as vkc
from vkc_pin.planning.initialization.approach_paths import ApproachPaths
from vkc_pin.planning.initialization.beam_search import BeamSearch
from vkc_pin.planning.initialization.keyframes import KeyframeSampler


@pytest.mark.parametrize("length", [0.1, 0.9])
def test_hand_approaches_and_retreats_straight(length: float) -> None:
    """A fixed base drives only if the arm alone cannot reach that far."""
    options = vkc.Options(reach_waypoints=20, turn_waypoints=6, move_waypoints=20, approach=length)
    steps = [vkc.Actuate("door", {"hinge": 1.2}), vkc.GoTo(-1.0, 0.5)]
    problem = make_program(load_door_scene(), steps, options=options)
    sampler = KeyframeSampler(problem, np.random.default_rng(0))
    found = BeamSearch(sampler).search(thorough=False)
    path = found.paths[int(np.argmin(found.cost))]
    phases = problem.task.phases
    grasp, release = (path[found.waypoints.index(int(problem.ends[k]))] for k in (0, 2))
    for keeps_base_fixed in (False, True):
        paths = ApproachPaths(sampler, keeps_base_fixed=keeps_base_fixed)
        approach = paths.find_approach_start(grasp, phases[0])
        retreat = paths.find_retreat_end(release, phases[3], phases[2])
        for z, (near,) in ((grasp, approach), (release, retreat)):
            hand, other = (
                dataclasses.replace(load_door_scene(), start=row[:9]).tool_placement()
                for row in (z, near)
            )
            offset = hand.inverse() * other
            np.testing.assert_allclose(offset.translation, [0.0, 0.0, -length], atol=1e-3)
            np.testing.assert_allclose(offset.rotation, np.eye(3), atol=1e-3)
            assert np.all(near[9:] == z[9:]), "the door does not move"
        driven = np.abs(approach[0] - grasp)[:3].max()
        assert (driven > 1e-3) == (not keeps_base_fixed or length == 0.9)
    alone = ApproachPaths(sampler).find_release_retreat(grasp, phases[3])
    np.testing.assert_array_equal(alone, approach if length == 0.1 else np.empty((0, len(grasp))))
    assert len(ApproachPaths(sampler).find_approach_start(release, phases[2])) == 0
