"""Tests the refinement of arm and object configurations out of collision at a fixed base."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from helpers.drawers import (
    SHORT,
    add_boxes,
    compute_handle_pose,
    compute_pose_error,
    compute_spare_clearance,
    load_drawer_scene,
    make_grasping_scene,
)
from helpers.small_problems import make_program

import vkc_pin as vkc
from vkc_pin.baselines.following import CLEAR, ArmKinematics, refine_configuration
from vkc_pin.planning.initialization.keyframes import KeyframeSampler
from vkc_pin.planning.nlp.merit import TOLERANCE

HALF, ROUNDING = 4, 1e-6  # waypoint; [m]
TILT, SLIDE = -2, -1  # columns


class Pulling:
    """A drawer that is half pulled out under a lamp; the hand may tilt about the bar."""

    def __init__(self, bottom: float, *, waypoint: int = HALF) -> None:
        scene = make_grasping_scene(attachment="handle_free")
        self.scene = add_boxes(scene, lamp=([0.3, 0.3, 0.1], [1.44, 0.0, bottom + 0.05]))
        self.problem = make_program(
            self.scene, [vkc.Actuate("drawer", {"slide": 0.3})], options=SHORT
        )
        self.sampler = KeyframeSampler(self.problem, np.random.default_rng(0))
        arm = ArmKinematics(self.problem, self.sampler)
        self.columns, self.waypoint = arm.columns, waypoint
        self.z, closed = arm.solve(self.sampler.object_motion[waypoint - 1], waypoint)
        assert closed

    def refine_configuration(
        self, z: np.ndarray | None = None, wanted: np.ndarray | None = None
    ) -> tuple[np.ndarray, bool]:
        start, near = self.z if z is None else z, self.z if wanted is None else wanted
        return refine_configuration(
            self.problem,
            self.sampler,
            start,
            wanted=near,
            waypoint=self.waypoint,
            columns=self.columns,
        )

    def compute_clearance(self, z: np.ndarray) -> float:
        return compute_spare_clearance(self.scene, z, slide=z[SLIDE], held=True)

    def compute_error(self, z: np.ndarray) -> float:
        return compute_pose_error(self.scene, z, compute_handle_pose(z[SLIDE], tilt=z[TILT]))


@cache
def make_low_lamp() -> Pulling:
    return Pulling(0.92)


@pytest.mark.parametrize("bottom", [0.96, 0.92, 0.9])
def test_refined_configuration_is_collision_free(bottom: float) -> None:
    pulling = Pulling(bottom)
    before = pulling.z.copy()
    assert pulling.compute_clearance(before) < -5e-3
    z, closed = pulling.refine_configuration()
    assert closed
    assert pulling.compute_clearance(z) >= -CLEAR - ROUNDING
    assert pulling.compute_error(z) < np.sqrt(3.0) * TOLERANCE
    np.testing.assert_array_equal(z[:3], before[:3])
    np.testing.assert_array_equal(pulling.z, before)
    assert np.all(
        (z >= pulling.problem.lower[HALF - 1] - ROUNDING)
        & (z <= pulling.problem.upper[HALF - 1] + ROUNDING)
    )
    assert z[SLIDE] != before[SLIDE], "the drawer moves as well"
    assert abs(z[SLIDE] - before[SLIDE]) < 0.02


def test_result_is_near_the_wanted_configuration() -> None:
    pulling = Pulling(0.96)
    near, _ = pulling.refine_configuration()
    wanted = pulling.z.copy()
    wanted[TILT] += 0.5
    tilted, closed = pulling.refine_configuration(wanted=wanted)
    assert closed
    assert pulling.compute_clearance(tilted) >= -CLEAR - ROUNDING
    assert tilted[TILT] > near[TILT] + 0.05


def test_goal_of_the_object_is_kept() -> None:
    pulling = Pulling(0.92, waypoint=8)
    assert pulling.compute_clearance(pulling.z) < 0.0
    z, closed = pulling.refine_configuration()
    assert closed
    assert pulling.compute_clearance(z) >= -CLEAR - ROUNDING
    assert z[SLIDE] == pytest.approx(0.3, abs=ROUNDING)


def test_open_chain_is_closed() -> None:
    pulling = make_low_lamp()
    start = pulling.z.copy()
    start[3:9] += np.random.default_rng(0).normal(0.0, 0.05, 6)
    assert pulling.compute_error(start) > 0.01
    z, closed = pulling.refine_configuration(start)
    assert closed
    assert pulling.compute_error(z) < np.sqrt(3.0) * TOLERANCE
    assert pulling.compute_clearance(z) >= -CLEAR - ROUNDING


def test_penetration_does_not_grow_without_free_space() -> None:
    pulling = Pulling(0.7)
    z, closed = pulling.refine_configuration()
    assert closed
    assert pulling.compute_error(z) < np.sqrt(3.0) * TOLERANCE
    assert pulling.compute_clearance(z) < -0.01
    assert pulling.compute_clearance(z) >= pulling.compute_clearance(pulling.z) - ROUNDING


def test_base_out_of_reach_leaves_the_chain_open() -> None:
    pulling = make_low_lamp()
    away = pulling.z.copy()
    away[0] -= 1.5
    z, closed = pulling.refine_configuration(away, away)
    assert not closed
    assert np.isfinite(z).all()
    np.testing.assert_array_equal(z[:3], away[:3])


def test_waypoints_without_closure_are_unchanged() -> None:
    problem = make_program(load_drawer_scene(), [vkc.Grasp("drawer")])
    sampler = KeyframeSampler(problem, np.random.default_rng(0))
    z, closed = refine_configuration(
        problem, sampler, problem.start, wanted=problem.start, waypoint=1, columns=np.arange(3, 9)
    )
    assert closed
    np.testing.assert_array_equal(z, problem.start)
