"""Tests collision pairs of carried objects, and of objects released where the motion chooses."""

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

COAL = 5e-6  # [m], differences between distances of coal, which depend on its last query
MARGIN, CLOSE = SHORT.dist_safe, SHORT.grasp_clearance
ASIDE = lift(STICK, [0.0, 0.5, 0.0])
POSE = pin.SE3(pin.rpy.rpyToMatrix(0.3, -2.0, 0.7), np.array([0.4, 0.2, 0.9]))


@cache
def make_scene() -> Scene:
    return make_room(describe_table(gap=0.05), describe_stand(gap=0.05), objects=("stick", "ball"))


@cache
def make_placing_problem() -> TrajectoryProblem:
    """Return the problem of taking the stick, putting it elsewhere, and driving away."""
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
    """Return (link, link or obstacle) → margins of pairs, "first" or "last", or unreduced."""
    part, every = (
        problem.contacts.phases[phase],
        np.arange(len(problem.contacts.phases[phase].pairs)),
    )
    found: dict[tuple[str, str], set[float]] = {}
    waypoint = problem.contacts.first_waypoint[phase + (at == "last")]
    asked = get_margins(part, every, np.full(len(every), waypoint)) if at else part.margins
    for (first, second), margin in zip(part.pairs, asked, strict=True):
        found.setdefault((part.labels[first], part.labels[second]), set()).add(float(margin))
    return found


def list_partners(problem: TrajectoryProblem, phase: int, label: str) -> set[str]:
    return {a if b == label else b for a, b in list_margins(problem, phase) if label in (a, b)}


def test_pairs_of_carried_and_resting_objects() -> None:
    """A carried object is paired with everything but itself and the hand."""
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
    }  # the hand is not what takes it
    assert ("stick.tip", "ball.ball") not in held
    assert held["stick.stick", "ball.ball"] == {MARGIN}
    robots = set(make_scene().robot.links)
    assert list_partners(make_fetching_problem(), 2, "ball.ball") == robots | {
        "stick.stick",
        "table",
        "stand",
        FLOOR,
    }
    after = list_margins(make_fetching_problem(), 3, at="first")
    assert after["stick.tip", "ball.ball"] == {0.0}


def compute_expected_placement(problem: TrajectoryProblem, name: str, row: np.ndarray) -> pin.SE3:
    """Return where the chain has an object at a configuration."""
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
    before = problem.contacts.evaluate(z, waypoints, reach=0.3)  # as the task expects
    first, other, again = (problem.evaluate_contacts(rows, reach=0.3) for rows in (z, z[::-1], z))
    after = problem.contacts.evaluate(z, waypoints, reach=0.3)
    assert not np.array_equal(before.pair, first.pair)
    assert not np.array_equal(first.pair, other.pair)
    for one, same in ((before, after), (first, again)):
        np.testing.assert_array_equal(one.pair, same.pair)
        np.testing.assert_allclose(one.distance, same.distance, rtol=0.0, atol=COAL)


def test_distances_equal_those_of_the_scene_after_the_release() -> None:
    """Compares with a problem of the last phase alone, in the scene that the motion leaves."""
    problem = make_fetching_problem()
    z = sample_configurations(
        problem.chain.lower,
        problem.chain.upper,
        problem.segments,
        np.random.default_rng(5),
        arena=1.0,
    )
    contacts = problem.evaluate_contacts(z, reach=0.3)
    stands = make_scene()
    for name, end in (("ball", problem.ends[2]), ("stick", problem.ends[4])):
        stands = stands.with_placement(name, compute_expected_placement(problem, name, z[end - 1]))
    alone = make_program(stands, [GoTo(1.0, 0.0)], options=SHORT)
    rows = np.arange(problem.ends[4], problem.ends[5])
    seen = alone.contacts.evaluate(
        z[rows][:, : alone.chain.size], np.ones(len(rows), int), reach=0.3
    )
    labels, own = problem.contacts.phases[5].labels, alone.contacts.phases[0].labels

    def table_of(found, labels, offset):  # type: ignore[no-untyped-def]
        return sorted(
            (int(row) - offset, labels[a], labels[b], round(float(distance), 5))
            for row, (a, b), distance in zip(
                found.waypoint, found.pair, found.distance, strict=True
            )
            if int(row) >= offset
        )

    first, second = table_of(contacts, labels, int(rows[0])), table_of(seen, own, 0)
    assert [entry[:3] for entry in first] == [entry[:3] for entry in second]
    np.testing.assert_allclose(
        [entry[3] for entry in first], [entry[3] for entry in second], rtol=0.0, atol=2e-5
    )
    assert any("ball.ball" in entry for entry in first)
