"""Tests collision pairs of carried objects, and of objects released at optimized poses."""

from __future__ import annotations

from functools import cache

import numpy as np
import pinocchio as pin
from helpers.carrying import STICK, describe_stand, describe_table, lift, make_room
from helpers.small_problems import SHORT, get_margins, make_program, sample_configurations

from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import GoTo, Grasp, Place, Reach, Release

COAL_TOLERANCE = 5e-6  # [m], since coal's distances depend on its previous query
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
    steps = [
        Grasp("stick"),
        Grasp("ball", "pull", "stick.tip"),
        Reach(POSE),
        Release("ball"),
        GoTo(0.0, 0.0),
    ]
    return make_program(
        make_scene(), [*steps, Place("stick", (0.8, 0.0, 0.6)), GoTo(1.0, 0.0)], options=SHORT
    )


def list_margins(
    problem: TrajectoryProblem, phase: int, *, at: str = ""
) -> dict[tuple[str, str], set[float]]:
    """Return (link, link or obstacle) → margins at the first or last waypoint, or unreduced."""
    part, all_pairs = (
        problem.contacts.phases[phase],
        np.arange(len(problem.contacts.phases[phase].pairs)),
    )
    found: dict[tuple[str, str], set[float]] = {}
    waypoint = problem.contacts.first_waypoint[phase + (at == "last")]
    margins = (
        get_margins(part, all_pairs, np.full(len(all_pairs), waypoint)) if at else part.margins
    )
    for (first, second), margin in zip(part.pairs, margins, strict=True):
        found.setdefault((part.labels[first], part.labels[second]), set()).add(float(margin))
    return found


def list_partners(problem: TrajectoryProblem, phase: int, label: str) -> set[str]:
    return {a if b == label else b for a, b in list_margins(problem, phase) if label in (a, b)}


def test_carried_objects_are_paired_with_everything_but_the_hand() -> None:
    """Resting objects are paired with the robot and carried objects only."""
    robot = make_scene().robot
    for phase in (0, 2):
        for label in ("stick.stick", "stick.tip", "ball.ball"):
            assert list_partners(make_placing_problem(), phase, label) == set(robot.links)
    assert list_partners(make_placing_problem(), 1, "ball.ball") == {
        *robot.links,
        "stick.stick",
        "stick.tip",
    }
    for label in ("stick.stick", "stick.tip"):
        hand = set(robot.touch_links) if label == "stick.stick" else set()
        others = {"ball.ball", "table", "stand", FLOOR}
        assert list_partners(make_placing_problem(), 1, label) == (set(robot.links) - hand) | others
    for (first, second), found in list_margins(make_placing_problem(), 1).items():
        assert found == {CLOSE if first in robot.touch_links and second == "stick.tip" else MARGIN}


def test_hand_margins_are_reduced_before_grasps_and_after_releases() -> None:
    hand = set(make_scene().robot.touch_links)
    for phase, at in ((0, "last"), (2, "first")):
        for (first, second), found in list_margins(make_placing_problem(), phase, at=at).items():
            assert found == {CLOSE if first in hand and second.startswith("stick.") else MARGIN}


def test_grasping_object_may_touch_the_grasped_one() -> None:
    before, held = (
        list_margins(make_fetching_problem(), 1, at="last"),
        list_margins(make_fetching_problem(), 2),
    )
    assert before["stick.tip", "ball.ball"] == {0.0}
    assert before["stick.stick", "ball.ball"] == {MARGIN}
    assert before[make_scene().robot.touch_links[0], "ball.ball"] == {
        MARGIN
    }  # the stick grasps the ball, not the hand
    assert ("stick.tip", "ball.ball") not in held
    assert held["stick.stick", "ball.ball"] == {MARGIN}
    robot_links = set(make_scene().robot.links)
    assert list_partners(make_fetching_problem(), 2, "ball.ball") == robot_links | {
        "stick.stick",
        "table",
        "stand",
        FLOOR,
    }
    after = list_margins(make_fetching_problem(), 3, at="first")
    assert after["stick.tip", "ball.ball"] == {0.0}


def compute_expected_placement(problem: TrajectoryProblem, name: str, row: np.ndarray) -> pin.SE3:
    """Return the placement of a held object at a configuration of the chain."""
    hold = next(hold for hold in problem.task.holds if hold.object == name)
    closure, data = problem.chain.closures[hold], problem.chain.model.createData()
    pin.forwardKinematics(problem.chain.model, data, problem.chain.coordinates.q(row))
    return data.oMi[closure.joint] * closure.local


def test_released_placements_do_not_depend_on_earlier_queries() -> None:
    problem = make_fetching_problem()
    z = sample_configurations(
        problem.chain.lower, problem.chain.upper, problem.segments, np.random.default_rng(4)
    )
    waypoints = np.arange(1, problem.segments + 1)
    before = problem.contacts.evaluate(z, waypoints, reach=0.3)  # with expected placements
    first, other, again = (problem.evaluate_contacts(rows, reach=0.3) for rows in (z, z[::-1], z))
    after = problem.contacts.evaluate(z, waypoints, reach=0.3)
    assert not np.array_equal(before.pair, first.pair)
    assert not np.array_equal(first.pair, other.pair)
    for one, same in ((before, after), (first, again)):
        np.testing.assert_array_equal(one.pair, same.pair)
        np.testing.assert_allclose(one.distance, same.distance, rtol=0.0, atol=COAL_TOLERANCE)


def test_distances_equal_those_of_the_scene_after_the_release() -> None:
    """The reference is a problem of the last phase alone, in the scene after the release."""
    problem = make_fetching_problem()
    z = sample_configurations(
        problem.chain.lower,
        problem.chain.upper,
        problem.segments,
        np.random.default_rng(5),
        arena=1.0,
    )
    contacts = problem.evaluate_contacts(z, reach=0.3)
    released_scene = make_scene()
    for name, end in (("ball", problem.ends[2]), ("stick", problem.ends[4])):
        released_scene = released_scene.with_placement(
            name, compute_expected_placement(problem, name, z[end - 1])
        )
    alone = make_program(released_scene, [GoTo(1.0, 0.0)], options=SHORT)
    rows = np.arange(problem.ends[4], problem.ends[5])
    reference = alone.contacts.evaluate(
        z[rows][:, : alone.chain.size], np.ones(len(rows), int), reach=0.3
    )
    labels, own = problem.contacts.phases[5].labels, alone.contacts.phases[0].labels

    def make_table(found, labels, offset):  # type: ignore[no-untyped-def]
        return sorted(
            (int(row) - offset, labels[a], labels[b], round(float(distance), 5))
            for row, (a, b), distance in zip(
                found.waypoint, found.pair, found.distance, strict=True
            )
            if int(row) >= offset
        )

    table, expected = make_table(contacts, labels, int(rows[0])), make_table(reference, own, 0)
    assert [entry[:3] for entry in table] == [entry[:3] for entry in expected]
    np.testing.assert_allclose(
        [entry[3] for entry in table], [entry[3] for entry in expected], rtol=0.0, atol=2e-5
    )
    assert any("ball.ball" in entry for entry in table)
