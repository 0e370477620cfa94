"""Tests of approach and retreat paths with a moving and a fixed base."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest
from helpers.small_problems import door_scene, program_of

import vkc_pin as vkc
from vkc_pin.planning.initialization.approach_paths import ApproachPaths
from vkc_pin.planning.initialization.beam_search import BeamSearch
from vkc_pin.planning.initialization.keyframes import KeyframeSampler

FEW = vkc.Options(reach_waypoints=20, turn_waypoints=6, move_waypoints=20)


@cache
def grasp() -> tuple[vkc.TrajectoryProblem, np.ndarray]:
    """Return the problem of opening the door and a configuration that holds its handle."""
    problem = program_of(door_scene(), [vkc.Actuate("door", {"hinge": 1.2})], options=FEW)
    found = BeamSearch(KeyframeSampler(problem, np.random.default_rng(0))).search(thorough=True)
    return problem, found.paths[int(np.argmin(found.cost)), 1]


def approach(*, keeps_base_fixed: bool) -> ApproachPaths:
    return ApproachPaths(
        KeyframeSampler(grasp()[0], np.random.default_rng(0)), keeps_base_fixed=keeps_base_fixed
    )


def back(z: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return the tool's motion from `z` to `near` in its own frame [m], and the turn's cosine."""
    hand, there = (
        dataclasses.replace(door_scene(), start=row[:9]).tool_placement() for row in (z, near)
    )
    off = hand.inverse() * there
    return np.array([*off.translation, (np.trace(off.rotation) - 1.0) / 2.0])


@pytest.mark.parametrize("keeps_base_fixed", [False, True])
def test_hand_retreats_straight_from_a_handle(keeps_base_fixed: bool) -> None:
    problem, z = grasp()
    (near,) = approach(keeps_base_fixed=keeps_base_fixed).find_approach_start(
        z, problem.task.phases[0]
    )
    np.testing.assert_allclose(back(z, near), [0.0, 0.0, -FEW.approach, 1.0], atol=1e-3)
    driven = np.abs(near - z)[:3].max()
    assert driven == 0.0 if keeps_base_fixed else driven > 1e-3
    assert np.all(near[9:] == z[9:]), "what is grasped stays where it is"


def test_base_drives_if_the_arm_alone_cannot_retreat(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, z = grasp()
    for metres in (0.6, 1.0):
        monkeypatch.setattr(problem, "options", dataclasses.replace(FEW, approach=metres))
        (near,) = approach(keeps_base_fixed=True)._move_tool(z, np.array([0.0, -1.0, 0.0]))
        alone = approach(keeps_base_fixed=True)._move_tool(
            z, np.array([0.0, -1.0, 0.0]), drives=False
        )
        hand, there = (
            dataclasses.replace(door_scene(), start=row[:9]).tool_placement() for row in (z, near)
        )
        np.testing.assert_allclose(
            there.translation - hand.translation, [0.0, -metres, 0.0], atol=1e-3
        )
        assert (len(alone) == 0) == bool(np.abs(near - z)[:3].max() > 0.0)
    assert len(alone) == 0, "it reaches a metre further: choose more"
