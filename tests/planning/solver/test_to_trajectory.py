"""Tests the conversion of waypoints to trajectories with pauses."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from helpers.carrying import STICK, describe_table, lift, make_room
from helpers.held_sticks import make_scene_with_held_stick
from helpers.small_problems import SHORT, load_door_scene, make_program, sample_configurations

from vkc_pin.planning.initialization.methods import initialize
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.solver.loop import solve
from vkc_pin.planning.solver.to_trajectory import close_chains, make_trajectory
from vkc_pin.world.task.steps import Actuate, GoTo, Grasp, Place, Release, Step
from vkc_pin.world.trajectory.trajectory import Trajectory

ASIDE = lift(STICK, [0.0, 0.5, 0.0])
HELD = {"stick": "grip"}
HELD_BALL = {**HELD, "ball": "pull"}


@cache
def make_fetch_problem() -> TrajectoryProblem:
    steps = [Grasp("ball", "pull", "stick.tip"), Place("ball", (0.8, 0.6, 0.7)), GoTo(0.0, 0.0)]
    return make_program(make_scene_with_held_stick(), steps, options=SHORT)


@cache
def make_place_problem() -> TrajectoryProblem:
    return make_program(make_room(describe_table()), [Place("stick", ASIDE)], options=SHORT)


def make_random_motion(problem: TrajectoryProblem) -> tuple[np.ndarray, Trajectory]:
    lower, upper, rng = problem.chain.lower, problem.chain.upper, np.random.default_rng(0)
    z = sample_configurations(lower, upper, problem.segments, rng)
    return z, make_trajectory(problem, z, problem.timing_for(problem.still).dt)


def find_pauses(problem: TrajectoryProblem, motion: Trajectory) -> list[int]:
    """Return the waypoints at which the robot has waited for the gripper."""
    robot = motion.robot_size
    still = (np.diff(motion.positions[:, :robot], axis=0) == 0.0).all(axis=1)
    times = np.diff(motion.times)
    np.testing.assert_allclose(times[still], problem.options.grasp_time)
    np.testing.assert_allclose(times[~still], problem.timing_for(problem.still).dt)
    return (np.flatnonzero(still) + 1).tolist()


@pytest.mark.parametrize(
    ("make", "phases"),
    [
        (
            make_fetch_problem,
            {"reach ball.pull by stick.tip": HELD, "place ball": HELD_BALL, "go to": HELD},
        ),
        # the last object is released at the end
        (make_place_problem, {"reach stick.grip": {}, "place stick": HELD, "let go": {}}),
    ],
)
def test_phases_list_attached_objects(
    make: Callable[[], TrajectoryProblem], phases: dict[str, dict[str, str]]
) -> None:
    _, motion = make_random_motion(make())
    assert {phase.name: dict(phase.held) for phase in motion.phases} == phases
    for phase, data in zip(motion.phases, motion.to_dict()["phases"], strict=True):
        assert data["by"] == ({"ball": "stick.tip"} if "ball" in dict(phase.held) else {})
    n = SHORT.reach_waypoints
    ends = [0, n, 2 * n + 1, len(motion.times) - 1]
    spans = [(phase.first, phase.last) for phase in motion.phases]
    assert spans == list(itertools.pairwise(ends))
    assert find_pauses(make(), motion) == [n + 1, 2 * n + 2]


@pytest.mark.parametrize(
    ("steps", "held", "last"),
    [
        ([Grasp("door"), Release()], {"door": "handle"}, "let go"),
        ([Actuate("door", {"knob": 0.3})], {}, "move door.knob"),
        ([Actuate("door", {"knob": 0.3}), Release()], {}, "let go"),
        ([Grasp("door")], {}, "reach door.handle"),
        ([Release()], {"door": "handle"}, "let go"),
    ],
)
def test_hand_opens_at_the_end_only_on_request(
    steps: list[Step], held: dict[str, str], last: str
) -> None:
    scene = load_door_scene().with_held(held) if steps[0] == Release() else load_door_scene()
    motion = make_random_motion(make_program(scene, steps, options=SHORT))[1]
    assert motion.phases[-1].name == last
    if last == "let go":
        assert dict(motion.phases[-1].held) == {}
        assert motion.phases[-1].last - motion.phases[-1].first == 1


def test_robot_waits_only_for_the_gripper() -> None:
    """There is no pause between turning the knob and moving the door."""
    steps: list[Step] = [Actuate("door", {"hinge": 1.2}), GoTo(0.0, 0.0)]
    problem = make_program(load_door_scene(), steps, options=SHORT)
    grasp, _, release, _ = problem.ends.tolist()
    assert find_pauses(problem, make_random_motion(problem)[1]) == [grasp + 1, release + 2]


def test_object_grasped_at_the_start_is_released_first() -> None:
    """A door grasped at the start is attached in no phase; its grasp keeps its value."""
    for attachment in ("handle", "handle_free"):
        scene = load_door_scene().with_held({"door": attachment})
        _, motion = make_random_motion(make_program(scene, [GoTo(0.0, 0.0)], options=SHORT))
        assert [dict(phase.held) for phase in motion.phases] == [{}]
    assert np.all(motion.column("door.handle_free") == 0.0)


@pytest.mark.parametrize("make", [make_fetch_problem, make_place_problem])
def test_robot_and_grasp_coordinates_follow_the_waypoints(
    make: Callable[[], TrajectoryProblem],
) -> None:
    """Grasp coordinates hold their values before and after the grasp."""
    problem = make()
    z, motion = make_random_motion(problem)
    rows = np.delete(motion.positions, find_pauses(problem, motion), axis=0)
    path, robot = problem.waypoints(z), motion.robot_size
    np.testing.assert_array_equal(rows[:, :robot], path[:, :robot])
    ends = [0, *problem.ends.tolist()]
    for hold, names in problem.chain.virtual.items():
        columns = [problem.chain.index(name) for name in names]
        held = [k for k, phase in enumerate(problem.task.phases) if hold in phase.held]
        nearest = np.clip(np.arange(len(rows)), ends[held[0]], ends[held[-1] + 1])
        np.testing.assert_array_equal(rows[:, columns], path[nearest][:, columns])


def test_chains_are_closed_between_waypoints_by_the_arm_alone() -> None:
    problem = make_program(load_door_scene(), [Actuate("door", {"hinge": 1.2})], options=SHORT)
    z = solve(problem, initialize(problem, "interpolated", 0).__next__().z).z
    motion = make_trajectory(problem, z, problem.timing_for(z).dt)
    middles = np.arange(len(motion.positions) - 1) + 0.5
    straight = (motion.positions[1:] + motion.positions[:-1]) / 2
    closed = close_chains(problem, straight, middles)
    (goal,) = (goal for goal in problem.pose_goals if goal.kind == "closure")
    (solver,) = (
        solver
        for one, solver in zip(problem.pose_goals, problem.pose_solvers, strict=True)
        if one is goal
    )
    is_held = np.array(
        [
            any(phase.first <= row < phase.last and phase.held for phase in motion.phases)
            for row in range(len(straight))
        ]
    )
    before = np.abs(solver.evaluate(straight[is_held], goal.target)[0]).max(axis=1)
    after = np.abs(solver.evaluate(closed[is_held], goal.target)[0]).max(axis=1)
    assert before.max() > 1e-4, "straight lines keep the closure"
    assert after.max() < 1e-6
    robot = problem.chain.robot.coordinates.size
    np.testing.assert_array_equal(closed[:, :3], straight[:, :3])
    np.testing.assert_array_equal(closed[:, robot:], straight[:, robot:])
    np.testing.assert_array_equal(closed[~is_held], straight[~is_held])
