"""Tests collision pairs of carried objects, and of objects released at optimized poses."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import STICK, describe_stand, describe_table, lift, make_room
from helpers.pair_margins import list_pair_margins
from helpers.small_problems import SHORT, make_program, sample_configurations

from vkc_pin.planning.chain.contacts import Contacts
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import GoTo, Grasp, Place, Reach, Release

MARGIN, CLOSE = SHORT.dist_safe, SHORT.grasp_clearance
ASIDE = lift(STICK, [0.0, 0.5, 0.0])
POSE = pin.SE3(pin.rpy.rpyToMatrix(0.3, -2.0, 0.7), np.array([0.4, 0.2, 0.9]))


@cache
def make_scene() -> Scene:
    return make_room(describe_table(gap=0.05), describe_stand(gap=0.05), objects=("stick", "ball"))


@cache
def make_placing_problem() -> TrajectoryProblem:
    """Return the problem of picking up the stick, placing it elsewhere, and driving away."""
    return make_program(make_scene(), [Place("stick", ASIDE), GoTo(0.0, 0.0)], options=SHORT)


@cache
def make_fetching_problem() -> TrajectoryProblem:
    """Return the problem of grasping the ball with the stick, then releasing ball and stick."""
    fetch = [Grasp("stick"), Grasp("ball", "pull", "stick.tip"), Reach(POSE), Release("ball")]
    place = [GoTo(0.0, 0.0), Place("stick", (0.8, 0.0, 0.6)), GoTo(1.0, 0.0)]
    return make_program(make_scene(), [*fetch, *place], options=SHORT)


def list_partners(problem: TrajectoryProblem, phase: int, label: str) -> set[str]:
    pairs = list_pair_margins(problem, phase)
    return {a if b == label else b for a, b in pairs if label in (a, b)}


def test_carried_objects_are_paired_with_everything_but_the_hand() -> None:
    """Resting objects are paired with the robot and carried objects only."""
    problem, robot = make_placing_problem(), make_scene().robot
    links, hand = set(robot.links), set(robot.touch_links)
    for phase in (0, 2):
        for label in ("stick.stick", "stick.tip", "ball.ball"):
            assert list_partners(problem, phase, label) == links
    others = {"ball.ball", "table", "stand", FLOOR}
    assert list_partners(problem, 1, "stick.stick") == (links - hand) | others
    assert list_partners(problem, 1, "stick.tip") == links | others
    assert list_partners(problem, 1, "ball.ball") == links | {"stick.stick", "stick.tip"}
    for (first, second), found in list_pair_margins(problem, 1).items():
        assert set(found) == {CLOSE if first in hand and second == "stick.tip" else MARGIN}


def test_grasping_object_may_touch_the_grasped_one() -> None:
    """The stick grasps the ball, not the hand."""
    problem, robot = make_fetching_problem(), make_scene().robot
    _, _, grasp, release, *_ = problem.contacts.first_waypoint.tolist()
    before, held, after = (
        list_pair_margins(problem, phase, waypoint=waypoint)
        for phase, waypoint in ((1, grasp), (2, None), (3, release))
    )
    for margins in (before, after):
        assert set(margins["stick.tip", "ball.ball"]) == {0.0}
    for margins in (before, held):
        assert set(margins["stick.stick", "ball.ball"]) == {MARGIN}
    assert set(before[robot.touch_links[0], "ball.ball"]) == {MARGIN}
    others = {"stick.stick", "table", "stand", FLOOR}
    assert list_partners(problem, 2, "ball.ball") == {*robot.links, *others}


def compute_expected_placement(problem: TrajectoryProblem, name: str, row: np.ndarray) -> pin.SE3:
    """Return the placement of a held object at a configuration of the chain."""
    hold = next(hold for hold in problem.task.holds if hold.object == name)
    closure, data = problem.chain.closures[hold], problem.chain.model.createData()
    pin.forwardKinematics(problem.chain.model, data, problem.chain.coordinates.q(row))
    return data.oMi[closure.joint] * closure.local


def sample_path(problem: TrajectoryProblem) -> np.ndarray:
    lower, upper, rng = problem.chain.lower, problem.chain.upper, np.random.default_rng(5)
    return sample_configurations(lower, upper, problem.segments, rng, arena=1.0)


def test_released_placements_do_not_depend_on_earlier_queries() -> None:
    problem = make_fetching_problem()
    z = sample_path(problem)
    waypoints = np.arange(1, problem.segments + 1)
    before = problem.contacts.evaluate(z, waypoints, reach=0.3)  # with expected placements
    first, other, again = (problem.evaluate_contacts(rows, reach=0.3) for rows in (z, z[::-1], z))
    after = problem.contacts.evaluate(z, waypoints, reach=0.3)
    assert not np.array_equal(before.pair, first.pair)
    assert not np.array_equal(first.pair, other.pair)
    for one, same in ((before, after), (first, again)):
        for part, same_part in zip(one.arrays(), same.arrays(), strict=True):
            np.testing.assert_array_equal(part, same_part)


def list_distances(
    problem: TrajectoryProblem, contacts: Contacts, first: int = 0
) -> tuple[list[tuple[int, str, str]], list[float]]:
    """Return (row, label, label) of all contacts from a row on, and their distances, sorted."""
    labels, rows = problem.contacts.phases[-1].labels, contacts.waypoint - first
    table = sorted(
        (int(row), labels[a], labels[b], float(distance))
        for row, (a, b), distance in zip(rows, contacts.pair, contacts.distance, strict=True)
        if row >= 0
    )
    return [entry[:3] for entry in table], [entry[3] for entry in table]


@pytest.mark.parametrize("make", [make_fetching_problem, make_placing_problem])
def test_distances_equal_those_of_the_scene_after_the_release(
    make: Callable[[], TrajectoryProblem],
) -> None:
    """The reference is a problem of the last phase alone, in the scene after the release."""
    problem, scene = make(), make_scene().with_placement("stick", ASIDE)
    z, (first, last) = sample_path(problem), problem.ends[-2:].tolist()
    if make is make_fetching_problem:
        for name, end in (("ball", problem.ends[2]), ("stick", first)):
            placement = compute_expected_placement(problem, name, z[end - 1])
            scene = scene.with_placement(name, placement)
    alone = make_program(scene, [GoTo(1.0, 0.0)], options=SHORT)
    rows = z[first:last, : alone.chain.size]
    reference = alone.contacts.evaluate(rows, np.ones(len(rows), int), reach=0.3)
    contacts = problem.evaluate_contacts(z, reach=0.3)
    keys, distances = list_distances(problem, contacts, first)
    expected_keys, expected = list_distances(alone, reference)
    assert keys == expected_keys
    np.testing.assert_allclose(distances, expected, rtol=0.0, atol=2e-5)
    assert any("stick.stick" in key for key in keys)
