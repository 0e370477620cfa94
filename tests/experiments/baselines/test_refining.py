"""Tests the refinement of arm and object configurations out of collision at a fixed base."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.drawers import (
    SHORT,
    add_boxes,
    compute_handle_pose,
    compute_pose_error,
    compute_spare_clearance,
    make_grasping_scene,
)
from helpers.small_problems import make_program

import vkc_pin as vkc
from vkc_pin.experiments.baselines.following import CLEAR, ArmKinematics, refine_configuration
from vkc_pin.planning.initialization.keyframes import KeyframeSampler
from vkc_pin.planning.nlp.merit import TOLERANCE

HALF, ROUNDING = 4, 1e-6  # waypoint; [m]
TILT, SLIDE = -2, -1  # columns


class Pulling:
    """A drawer that is half pulled out under a lamp; the hand may tilt about the bar."""

    def __init__(self, bottom: float, *, waypoint: int = HALF) -> None:
        scene = make_grasping_scene(attachment="handle_free")
        self.scene = add_boxes(scene, lamp=([0.3, 0.3, 0.1], [1.44, 0.0, bottom + 0.05]))
        pull = vkc.Actuate("drawer", {"slide": 0.3})
        self.problem = make_program(self.scene, [pull], options=SHORT)
        self.sampler = KeyframeSampler(self.problem, np.random.default_rng(0))
        self.arm, self.waypoint = ArmKinematics(self.problem, self.sampler), waypoint
        self.z, closed = self.arm.solve(self.sampler.object_motion[waypoint - 1], waypoint)
        assert closed

    def refine_configuration(
        self, z: np.ndarray | None = None, wanted: np.ndarray | None = None
    ) -> tuple[np.ndarray, bool]:
        return refine_configuration(
            self.problem,
            self.sampler,
            self.z if z is None else z,
            wanted=self.z if wanted is None else wanted,
            waypoint=self.waypoint,
            columns=self.arm.columns,
        )

    def refine_freely(self, z: np.ndarray | None = None, **wanted: np.ndarray) -> np.ndarray:
        """Return the refined configuration, which is closed and collision-free."""
        found, closed = self.refine_configuration(z, **wanted)
        assert closed
        assert self.compute_error(found) < np.sqrt(3.0) * TOLERANCE
        assert self.compute_clearance(found) >= -CLEAR - ROUNDING
        return found

    def compute_clearance(self, z: np.ndarray) -> float:
        return compute_spare_clearance(self.scene, z, slide=z[SLIDE], held=True)

    def compute_error(self, z: np.ndarray) -> float:
        return compute_pose_error(self.scene, z, compute_handle_pose(z[SLIDE], tilt=z[TILT]))


@pytest.mark.parametrize("bottom", [0.96, 0.92, 0.9])
def test_refined_configuration_is_collision_free(bottom: float) -> None:
    pulling = Pulling(bottom)
    before = pulling.z.copy()
    assert pulling.compute_clearance(before) < -5e-3
    z = pulling.refine_freely()
    np.testing.assert_array_equal(z[:3], before[:3])
    np.testing.assert_array_equal(pulling.z, before)
    lower, upper = pulling.problem.lower[HALF - 1], pulling.problem.upper[HALF - 1]
    assert np.all((z >= lower - ROUNDING) & (z <= upper + ROUNDING))
    assert 0.0 < abs(z[SLIDE] - before[SLIDE]) < 0.02, "the drawer moves as well"


def test_result_is_near_the_wanted_configuration() -> None:
    pulling = Pulling(0.96)
    wanted = pulling.z.copy()
    wanted[TILT] += 0.5
    tilted, near = pulling.refine_freely(wanted=wanted), pulling.refine_freely()
    assert tilted[TILT] > near[TILT] + 0.05


def test_goal_of_the_object_is_kept() -> None:
    pulling = Pulling(0.92, waypoint=8)
    assert pulling.compute_clearance(pulling.z) < 0.0
    assert pulling.refine_freely()[SLIDE] == pytest.approx(0.3, abs=ROUNDING)


def test_open_chain_is_closed() -> None:
    pulling = Pulling(0.92)
    start = pulling.z.copy()
    start[3:9] += np.random.default_rng(0).normal(0.0, 0.05, 6)
    assert pulling.compute_error(start) > 0.01
    pulling.refine_freely(start)


def test_penetration_does_not_grow_without_free_space() -> None:
    pulling = Pulling(0.7)
    z, closed = pulling.refine_configuration()
    assert closed
    assert pulling.compute_error(z) < np.sqrt(3.0) * TOLERANCE
    assert pulling.compute_clearance(z) < -0.01
    assert pulling.compute_clearance(z) >= pulling.compute_clearance(pulling.z) - ROUNDING


def test_base_out_of_reach_leaves_the_chain_open() -> None:
    pulling = Pulling(0.92)
    away = pulling.z.copy()
    away[0] -= 1.5
    z, closed = pulling.refine_configuration(away, away)
    assert not closed
    assert np.isfinite(z).all()
    np.testing.assert_array_equal(z[:3], away[:3])
