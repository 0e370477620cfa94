"""Moving arm and object out of collision while the base stands, and the gradients of distances it uses."""

from __future__ import annotations

from functools import cache

import coal
import numpy as np
import pinocchio as pin
import pytest
from helpers.drawers import SHORT, drawer_scene, handle, holding, off, spare, with_boxes
from helpers.small_problems import all_pairs, program_of

import vkc_pin as vkc
from vkc_pin.baselines import refining as module
from vkc_pin.baselines.arm_kinematics import ArmKinematics
from vkc_pin.baselines.postures import base_poses
from vkc_pin.baselines.refining import CLEAR, refined
from vkc_pin.planning.initialization.keyframes import KeyframeSampler
from vkc_pin.planning.nlp.merit import TOLERANCE

HALF, ROUNDING = 4, 1e-6  # a waypoint; [m]
TILT, SLIDE = -2, -1  # columns


class Pulling:
    """Half-way through pulling a drawer, a lamp above the wrist; the hand may tilt about the bar."""

    def __init__(self, bottom: float, *, waypoint: int = HALF) -> None:
        scene = holding(attachment="handle_free")
        self.scene = with_boxes(scene, lamp=([0.3, 0.3, 0.1], [1.44, 0.0, bottom + 0.05]))
        self.problem = program_of(
            self.scene, [vkc.Actuate("drawer", {"slide": 0.3})], options=SHORT
        )
        self.knots = KeyframeSampler(self.problem, np.random.default_rng(0))
        arm = ArmKinematics(self.problem, self.knots)
        self.columns, self.waypoint = arm.columns, waypoint
        self.z, closed = arm.solve(self.knots.object_motion[waypoint - 1], waypoint)
        assert closed

    def refined(
        self, z: np.ndarray | None = None, wanted: np.ndarray | None = None
    ) -> tuple[np.ndarray, bool]:
        start, near = self.z if z is None else z, self.z if wanted is None else wanted
        return refined(
            self.problem,
            self.knots,
            start,
            wanted=near,
            waypoint=self.waypoint,
            columns=self.columns,
        )

    def spare(self, z: np.ndarray) -> float:
        return spare(self.scene, z, slide=z[SLIDE], held=True)

    def off(self, z: np.ndarray) -> float:
        return off(self.scene, z, handle(z[SLIDE], tilt=z[TILT]))


@cache
def low() -> Pulling:
    return Pulling(0.92)


@pytest.mark.parametrize("bottom", [0.96, 0.92, 0.9])
def test_out_of_collision(bottom: float) -> None:
    pulling = Pulling(bottom)
    given = pulling.z.copy()
    assert pulling.spare(given) < -5e-3
    z, closed = pulling.refined()
    assert closed
    assert pulling.spare(z) >= -CLEAR - ROUNDING
    assert pulling.off(z) < np.sqrt(3.0) * TOLERANCE
    np.testing.assert_array_equal(z[:3], given[:3])
    np.testing.assert_array_equal(pulling.z, given)
    assert np.all(
        (z >= pulling.problem.lower[HALF - 1] - ROUNDING)
        & (z <= pulling.problem.upper[HALF - 1] + ROUNDING)
    )
    assert z[SLIDE] != given[SLIDE], "the drawer gives way, too"
    assert abs(z[SLIDE] - given[SLIDE]) < 0.02


def test_what_is_free_and_closed_stays() -> None:
    pulling = Pulling(1.2)
    z, closed = pulling.refined(wanted=pulling.z + 0.1)
    assert closed
    np.testing.assert_array_equal(z, pulling.z)


def test_it_stays_near_what_is_wanted() -> None:
    pulling = Pulling(0.96)
    near, _ = pulling.refined()
    wanted = pulling.z.copy()
    wanted[TILT] += 0.5
    tilted, closed = pulling.refined(wanted=wanted)
    assert closed
    assert pulling.spare(tilted) >= -CLEAR - ROUNDING
    assert tilted[TILT] > near[TILT] + 0.05


def test_moving_the_drawer_is_dear(monkeypatch: pytest.MonkeyPatch) -> None:
    pulling = low()
    moved = [abs(pulling.refined()[0][SLIDE] - pulling.z[SLIDE])]
    monkeypatch.setattr(module, "_OBJECT", 1000.0)
    moved.append(abs(pulling.refined()[0][SLIDE] - pulling.z[SLIDE]))
    assert 0.0 < moved[1] < 0.1 * moved[0]


def test_at_the_end_the_drawer_is_where_it_should_be() -> None:
    pulling = Pulling(0.92, waypoint=8)
    assert pulling.spare(pulling.z) < 0.0
    z, closed = pulling.refined()
    assert closed
    assert pulling.spare(z) >= -CLEAR - ROUNDING
    assert z[SLIDE] == pytest.approx(0.3, abs=ROUNDING)


def test_from_an_arm_off_the_handle() -> None:
    pulling = low()
    start = pulling.z.copy()
    start[3:9] += np.random.default_rng(0).normal(0.0, 0.05, 6)
    assert pulling.off(start) > 0.01
    z, closed = pulling.refined(start)
    assert closed
    assert pulling.off(z) < np.sqrt(3.0) * TOLERANCE
    assert pulling.spare(z) >= -CLEAR - ROUNDING


def test_where_there_is_no_room() -> None:
    """The chain is closed all the same, and the least is in collision that can be."""
    pulling = Pulling(0.7)
    z, closed = pulling.refined()
    assert closed
    assert pulling.off(z) < np.sqrt(3.0) * TOLERANCE
    assert pulling.spare(z) < -0.01
    assert pulling.spare(z) >= pulling.spare(pulling.z) - ROUNDING


def test_out_of_reach() -> None:
    pulling = low()
    away = pulling.z.copy()
    away[0] -= 1.5
    z, closed = pulling.refined(away, away)
    assert not closed
    assert np.isfinite(z).all()
    np.testing.assert_array_equal(z[:3], away[:3])


def test_where_nothing_must_hold() -> None:
    problem = program_of(drawer_scene(), [vkc.Grasp("drawer")])
    knots = KeyframeSampler(problem, np.random.default_rng(0))
    z, closed = refined(
        problem, knots, problem.start, wanted=problem.start, waypoint=1, columns=np.arange(3, 9)
    )
    assert closed
    np.testing.assert_array_equal(z, problem.start)


@pytest.mark.parametrize("held", [False, True])
def test_gradients_are_those_of_coals_distances(held: bool) -> None:
    """Central differences of distances that coal finds between the shapes where Pinocchio has them; off parallel faces."""
    rng, step = np.random.default_rng(1), 1e-5
    if held:
        pulling = low()
        problem, waypoint = pulling.problem, HALF
        z = np.tile(pulling.z, (6, 1))
    else:
        problem = program_of(drawer_scene(), [vkc.Grasp("drawer")], options=SHORT)
        waypoint = problem.segments
        z = base_poses(problem, waypoint, problem.start, rng)[:6]
    z[:, :9] += rng.normal(0.0, 0.05, (len(z), 9))
    contacts = problem.contacts.evaluate(z, np.full(len(z), waypoint), reach=0.12)
    chain, geometry = (
        problem.chain,
        all_pairs(problem.contacts.phases[problem.contacts.find_phase(waypoint)]),
    )
    data, shapes = chain.model.createData(), pin.GeometryData(geometry)
    request = coal.DistanceRequest()
    request.gjk_tolerance = 1e-8

    def distances(at: np.ndarray) -> np.ndarray:
        found = np.empty(len(contacts.distance))
        for row in range(len(at)):
            pin.updateGeometryPlacements(
                chain.model, data, geometry, shapes, chain.coordinates.q(at[row])
            )
            for k in np.flatnonzero(contacts.waypoint == row):
                one, other = (geometry.geometryObjects[int(i)].geometry for i in contacts.pair[k])
                where, there = (
                    coal.Transform3s(shapes.oMg[int(i)].rotation, shapes.oMg[int(i)].translation)
                    for i in contacts.pair[k]
                )
                found[k] = coal.distance(one, where, other, there, request, coal.DistanceResult())
        return found

    apart = distances(z)
    np.testing.assert_allclose(contacts.distance, apart, atol=1e-6)
    gradients = problem.contacts.compute_gradients(z, contacts)
    assert gradients.shape == (len(apart), chain.size)
    assert len(apart) > 40
    numeric = np.empty_like(gradients)
    for column in range(chain.size):
        change = np.zeros(chain.size)
        change[column] = step
        numeric[:, column] = (distances(z + change) - distances(z - change)) / (2 * step)
    clear = apart > 1e-3  # of how deep it is coal knows less
    np.testing.assert_allclose(gradients[clear], numeric[clear], atol=2e-3)
    moving = 10 if held else 9  # the drawer's case stands in the world whatever its own joint says
    assert np.abs(gradients).max(axis=0)[:moving].min() > 1e-3
    np.testing.assert_array_equal(gradients[:, moving:], 0.0)
