"""Compares distances and witness planes with coal."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from helpers.small_problems import (
    SHORT,
    load_door_scene,
    make_program,
    sample_configurations,
)

from vkc_pin.planning.chain.collision_pairs import build_phase_geometries
from vkc_pin.planning.chain.contacts import Contacts
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.budget import Budget, BudgetExhaustedError
from vkc_pin.world.models.shapes import compute_shape_distance
from vkc_pin.world.task.steps import Actuate, GoTo


@cache
def make_door_problem() -> TrajectoryProblem:
    """Return the problem of opening the door and driving away: reach, turn, move, go to."""
    return make_program(
        load_door_scene(), [Actuate("door", {"hinge": 1.2}), GoTo(0.0, 0.0)], options=SHORT
    )


def sample_rows(count: int, seed: int = 0) -> np.ndarray:
    chain, rng = make_door_problem().chain, np.random.default_rng(seed)
    return sample_configurations(chain.lower, chain.upper, count, rng)


def compute_distances(phase: int, contacts: Contacts, z: np.ndarray) -> np.ndarray:
    """Return coal's signed distance of the pair of each contact at other configurations z."""
    problem = make_door_problem()
    shapes = problem.contacts.phases[phase].shapes
    rotations, translations = problem.chain.joint_placements(z)
    found = []
    for row, pair in zip(contacts.waypoint, contacts.pair.tolist(), strict=True):
        solids, placements = [], []
        for shape in (shapes[k] for k in pair):
            joint = rotations[row, shape.parentJoint], translations[row, shape.parentJoint]
            solids.append(shape.geometry)
            placements.append(pin.SE3(*joint) * shape.placement)
        found.append(compute_shape_distance(solids[0], placements[0], solids[1], placements[1]))
    return np.array(found)


def test_batch_evaluation_equals_single_evaluations() -> None:
    problem = make_door_problem()
    z, waypoints = sample_rows(12), problem.ends[np.arange(12) % 4]
    together = problem.contacts.evaluate(z, waypoints, reach=0.3)
    assert set(together.waypoint.tolist()) == set(range(12))
    phases = problem.contacts.find_phases(np.arange(waypoints.max() + 1)).tolist()
    assert [problem.contacts.find_phase(waypoint) for waypoint in range(len(phases))] == phases
    for row in range(12):
        alone = problem.contacts.evaluate(z[[row]], waypoints[[row]], reach=0.3)
        here = together.select(np.flatnonzero(together.waypoint == row))
        for one, other in zip(here.arrays()[1:], alone.arrays()[1:], strict=True):
            np.testing.assert_array_equal(one, other)
        assert not alone.waypoint.any()


def test_no_contacts_within_reach() -> None:
    problem = make_door_problem()
    contacts = problem.contacts.evaluate(problem.start[None], np.array([1]), reach=1e-6)
    assert contacts.pair.shape == (0, 2)
    assert contacts.normal.shape == contacts.first.shape == contacts.second.shape == (0, 3)
    assert contacts.compute_clearance() == np.inf
    assert contacts.compute_violation() == 0.0
    np.testing.assert_array_equal(contacts.compute_shortfall(3), np.zeros(3))
    planes, offsets = problem.contacts.compute_planes(problem.start[None], contacts, slots=4)
    assert (np.count_nonzero(planes), offsets.tolist()) == (0, [[-1.0] * 4])


def test_shortfall_violation_and_clearance() -> None:
    contacts = Contacts(
        waypoint=np.array([0, 0, 2]),
        pair=np.zeros((3, 2), int),
        distance=np.array([0.004, 0.015, -0.03]),
        margin=np.array([0.005, 0.02, 0.02]),
        normal=np.zeros((3, 3)),
        first=np.zeros((3, 3)),
        second=np.zeros((3, 3)),
    )
    np.testing.assert_allclose(contacts.compute_shortfall(4), [0.005, 0.0, 0.05, 0.0])
    assert contacts.compute_violation() == pytest.approx(0.05)
    assert contacts.compute_clearance() == -0.03
    apart = dataclasses.replace(contacts, distance=np.array([0.005, 0.02, 0.03]))
    assert apart.compute_violation() == 0.0
    np.testing.assert_array_equal(apart.compute_shortfall(3), np.zeros(3))
    assert contacts.slot.tolist() == [0, 1, 0]
    assert contacts.select(np.array([2, 0])).distance.tolist() == [-0.03, 0.004]


@pytest.mark.parametrize("phase", [0, 2])
def test_planes_have_value_and_gradient_of_the_signed_distance(phase: int) -> None:
    """At kinks of the distance, the slope must lie between the one-sided differences."""
    problem, step, slots = make_door_problem(), 1e-4, 40
    chain, rng = problem.chain, np.random.default_rng(phase)
    z, waypoints = sample_rows(30, phase), np.full(30, problem.ends[phase])
    contacts = problem.contacts.evaluate(z, waypoints, reach=0.25, nearest=slots)
    here = compute_distances(phase, contacts, z)
    np.testing.assert_allclose(contacts.distance, here, rtol=0.0, atol=5e-6)
    np.testing.assert_allclose(np.linalg.norm(contacts.normal, axis=1), 1.0, atol=1e-9)
    along = np.einsum("ci,ci->c", contacts.normal, contacts.second - contacts.first)
    np.testing.assert_allclose(along, contacts.distance, rtol=0.0, atol=1e-9)
    planes, offsets = problem.contacts.compute_planes(z, contacts, slots=slots)
    at = contacts.waypoint, contacts.slot
    is_unused = np.ones((len(z), slots), bool)
    is_unused[at] = False
    assert not planes[is_unused].any()
    assert (offsets[is_unused] == -1.0).all()

    def evaluate(z: np.ndarray) -> np.ndarray:
        rotations, translations = chain.joint_placements(z)
        columns = [rotations[:, 1:].swapaxes(2, 3), translations[:, 1:, None]]
        placements = np.concatenate(columns, axis=2).reshape(len(z), -1)
        return np.einsum("ci,ci->c", planes[at], placements[contacts.waypoint])

    shortfall = contacts.distance - contacts.margin
    np.testing.assert_allclose(evaluate(z) - offsets[at], shortfall, rtol=0.0, atol=1e-9)
    gradients = problem.contacts.compute_gradients(z, contacts)
    for direction in rng.normal(size=(4, chain.size)):
        ahead, behind = z + step * direction, z - step * direction
        slope = (evaluate(ahead) - evaluate(behind)) / (2 * step)
        np.testing.assert_allclose(gradients @ direction, slope, rtol=0.0, atol=1e-5)
        right = (compute_distances(phase, contacts, ahead) - here) / step
        left = (here - compute_distances(phase, contacts, behind)) / step
        outside = np.maximum(np.minimum(left, right) - slope, slope - np.maximum(left, right))
        assert np.median(outside) < 1e-3
        assert outside.max() < 2e-2


def test_planes_of_the_worst_contacts_are_kept() -> None:
    problem, z = make_door_problem(), sample_rows(10)
    contacts = problem.contacts.evaluate(z, np.full(10, problem.ends[0]), reach=0.5)
    few, few_offsets = problem.contacts.compute_planes(z, contacts, slots=2)
    many, many_offsets = problem.contacts.compute_planes(z, contacts, slots=30)
    assert np.bincount(contacts.waypoint).min() > 2
    np.testing.assert_array_equal(few, many[:, :2])
    np.testing.assert_array_equal(few_offsets, many_offsets[:, :2])


def test_evaluations_count_towards_the_budget() -> None:
    """The check of a run stops at its first collision."""
    problem = make_door_problem()
    z = np.tile(problem.start, (5, 1))
    inside = z.copy()
    inside[2:, :2] = load_door_scene().objects["door"].placement.translation[:2]
    with Budget().activate() as budget:
        problem.contacts.evaluate(z, np.ones(5, int), reach=0.1)
    assert budget.evaluations == 5
    rows, edges = np.concatenate([z, inside, inside[2:]]), np.array([0, 5, 10, 10, 13])
    with Budget().activate() as budget:
        free = problem.contacts.count_free(rows, edges, 1, reach=0.1, allowed=0.01)
    assert free.tolist() == [5, 2, 0, 0]
    assert budget.evaluations == 5 + 3 + 0 + 1
    with Budget(seconds=0.0).activate(), pytest.raises(BudgetExhaustedError):
        build_phase_geometries(load_door_scene(), problem.chain, problem.task, SHORT)
