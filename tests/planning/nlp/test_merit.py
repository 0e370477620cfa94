"""Tests constraint violations along a motion and the exact ℓ1 merit function."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from helpers.drives import make_hall
from helpers.small_problems import load_door_scene, make_program

import vkc_pin as vkc
from vkc_pin.planning.nlp.merit import (
    GROWTH,
    MAX_WEIGHT,
    TOLERANCE,
    Infeasibility,
    Merit,
    compute_shortfalls,
    measure_infeasibility,
)

KINDS = tuple(Merit(1.0).weights)
SHORT = vkc.Options(reach_waypoints=8, turn_waypoints=4, move_waypoints=6)
TALL = vkc.Constraint("tall", lambda s: s.position("tool")[2], lower=2.0, tolerance=0.02)
PILLAR = {
    "name": "pillar",
    "type": "cylinder",
    "radius": 0.15,
    "length": 1.6,
    "position": [0.9, 0.0, 0.8],
}


@cache
def make_problem(kind: str) -> vkc.TrajectoryProblem:
    if kind == "door":
        return make_program(load_door_scene(), [vkc.Actuate("door", {"hinge": 1.2})], options=SHORT)
    scene = make_hall(base="differential", obstacles=[PILLAR])
    return make_program(scene, [vkc.GoTo(1.2, 0.4)], options=SHORT, terms=[TALL])


def measure(p: vkc.TrajectoryProblem, z: np.ndarray, *, rates: bool) -> Infeasibility:
    reach, slots = p.options.contact_reach, p.options.contact_slots
    contacts = p.evaluate_contacts(z, reach=reach, nearest=slots)
    return measure_infeasibility(p, z, p.timing_for(p.still), contacts, rates=rates)


def sample_path(p: vkc.TrajectoryProblem, seed: int) -> np.ndarray:
    return p.clip(p.still + np.random.default_rng(seed).normal(0.0, 0.3, p.still.shape))


def make_infeasibility(**amounts: list[float]) -> Infeasibility:
    rows = {kind: np.array(amounts.get(kind, [0.0, 0.0])) for kind in KINDS}
    return Infeasibility(rows, np.zeros((2, 0, 7)), np.zeros(0), np.zeros(0))


@pytest.mark.parametrize("seed", range(3))
def test_amounts_equal_the_violations_of_each_kind(seed: int) -> None:
    p = make_problem("drive")
    z, timing = sample_path(p, seed), p.timing_for(p.still)
    found, path = measure(p, z, rates=True), p.waypoints(z)
    _, lateral, _ = p.rolling.compute_steps(path)
    deficit = np.maximum(p.rolling.compute_min_times(path) - timing.dt, 0.0)  # of the faster wheel
    lower_bound = np.abs(lateral) + deficit * p.rolling.wheel_speed
    assert (found.amounts["rolling"] >= lower_bound - 1e-9).all()
    relaxed = measure(p, z, rates=False).amounts
    np.testing.assert_allclose(relaxed["rolling"], np.abs(lateral), atol=1e-12)
    assert not relaxed["rates"].any()
    assert (np.count_nonzero(list(p.row_kinds.values()), axis=0) == 1).all()
    terms = p.term_evaluator.compute_violation(z, timing.dt)
    assert found.amounts["terms"].max() == pytest.approx(terms)
    limits = (timing.velocity, timing.acceleration)
    excess = [
        np.maximum(np.abs(r) - m, 0.0).sum()
        for r, m in zip(p.rates(z, timing.dt), limits, strict=True)
    ]
    assert found.amounts["rates"].sum() == pytest.approx(sum(excess))
    assert np.abs(found.rate_excess).sum() == pytest.approx(sum(excess))


def test_pose_amounts_are_distance_plus_angle() -> None:
    p = make_problem("door")
    z = sample_path(p, 0)
    found = measure(p, z, rates=False)
    expected = np.zeros(len(z))
    for goal, solver in zip(p.pose_goals, p.pose_solvers, strict=True):
        at = np.array(goal.row.waypoints) - 1
        distance, sine = np.linalg.norm(
            solver.evaluate(z[at], goal.target)[0].reshape(-1, 2, 3), axis=2
        ).T
        expected[at] += distance + 2.0 * np.arcsin(sine / 2.0)
    np.testing.assert_allclose(found.amounts["poses"], expected, atol=1e-8)
    assert found.total == pytest.approx(sum(amount.sum() for amount in found.amounts.values()))
    assert found.max_violation == pytest.approx(expected.max())
    assert not found.rate_excess.size


def test_shortfalls_equal_those_of_pairs_with_planes() -> None:
    p = make_problem("drive")
    contacts = p.evaluate_contacts(sample_path(p, 0), reach=p.options.contact_reach)
    found = compute_shortfalls(contacts, p.segments, 2)
    assert found.any()
    for row in range(p.segments):
        own = np.flatnonzero(contacts.waypoint == row)[:2]
        expected = np.maximum(contacts.margin[own] - contacts.distance[own], 0.0)
        np.testing.assert_allclose(found[row], np.pad(expected, (0, 2 - len(own))))


def test_penalty_is_the_weighted_sum_of_amounts() -> None:
    merit = Merit(2.0)
    found = make_infeasibility(clearance=[1.0, 3.0], poses=[0.25, 0.0], rates=[0.0, 0.5])
    merit.weights["poses"] = 8.0
    assert merit.compute_penalty(found, clearance=True).tolist() == [4.0, 7.0]
    assert merit.compute_penalty(found, clearance=False).tolist() == [2.0, 1.0]
    assert found.max_violation == 0.5  # without clearance
    for kind in KINDS:
        single = make_infeasibility(**{kind: [0.0, 0.5]})
        assert Merit(2.0).compute_penalty(single, clearance=True).tolist() == [0.0, 1.0]


def test_weights_of_violated_kinds_increase() -> None:
    """Each kind has the tolerance with which a solution is accepted; see `TOLERANCE`."""
    merit = Merit(2.0)
    small, large = 0.9 * TOLERANCE, 1.1 * TOLERANCE
    found = make_infeasibility(clearance=[0.0, 0.2], poses=[small, 0.0], terms=[large, 0.0])
    assert merit.increase_weights(found, 0.1)
    increased = {"clearance": 2.0 * GROWTH, "terms": 2.0 * GROWTH}
    assert merit.weights == {**dict.fromkeys(KINDS, 2.0), **increased}
    assert not merit.increase_weights(make_infeasibility(poses=[small]), 0.1)
    assert not merit.increase_weights(make_infeasibility(clearance=[0.09]), 0.1)
    for kind in set(KINDS) - {"clearance"}:
        assert Merit(2.0).increase_weights(make_infeasibility(**{kind: [large]}), 0.1)
    merit.weights["clearance"] = MAX_WEIGHT  # the weight cannot increase further
    assert not merit.increase_weights(make_infeasibility(clearance=[0.2]), 0.1)
