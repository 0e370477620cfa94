"""Tests the program of a task: bounds, pose goals, rates and rows."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import STICK, describe_table, lift, make_room
from helpers.held_sticks import make_scene_with_held_stick
from helpers.small_problems import (
    SHORT,
    load_door_scene,
    make_full_scene,
    make_program,
    sample_configurations,
)

from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.solver.to_trajectory import make_trajectory
from vkc_pin.validation.tolerances import Tolerances
from vkc_pin.world.models.robot_file import load_robot
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.compiler import LATCH_MARGIN
from vkc_pin.world.task.steps import Actuate, GoTo, Grasp, Place, Reach, Release, Step, Touch

POSE = pin.SE3(pin.rpy.rpyToMatrix(0.3, -2.0, 0.7), np.array([0.4, 0.2, 0.9]))
HANDLE = Hold("door", "handle")
PULL = Actuate("drawer", {"slide": 0.2}, attachment="handle_free")
REACH, TURN, MOVE = SHORT.reach_waypoints, SHORT.turn_waypoints, SHORT.move_waypoints
OPEN = REACH + TURN + MOVE
APPROACH = SHORT.steps(SHORT.approach_time)


@pytest.fixture(scope="module")
def opening() -> TrajectoryProblem:
    """Return the problem of opening the door, beyond its limit, and driving away."""
    steps = [Actuate("door", {"hinge": 2.0}), GoTo(-0.5, 0.1, -2.2)]
    return make_program(load_door_scene(), steps, options=SHORT)


def get_bounds(problem: TrajectoryProblem, name: str) -> np.ndarray:
    """Return the bounds of a coordinate at each waypoint after the start, shape (N, 2)."""
    index = problem.chain.index(name)
    return np.column_stack([problem.lower[:, index], problem.upper[:, index]])


def sample_path(problem: TrajectoryProblem, scale: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(0)
    far = sample_configurations(problem.chain.lower, problem.chain.upper, problem.segments, rng)
    return problem.start + scale * (far - problem.start)


# --- bounds
# ------------------------------------------------------------------------------------------------


def test_object_joints_are_fixed_until_they_are_moved(opening: TrajectoryProblem) -> None:
    assert [phase.segments for phase in opening.task.phases] == [REACH, TURN, MOVE, REACH]
    turned = 0.5 + LATCH_MARGIN
    reach, turn, move, last = opening.ends.tolist()
    assert opening.segments == opening.transcription.segments == last
    hinge, knob = get_bounds(opening, "door.hinge"), get_bounds(opening, "door.knob")
    assert np.all(hinge[:turn] == 0.0)
    assert np.all(hinge[turn : move - 1] == (-1.57, 1.57))
    assert np.all(hinge[move - 1 :] == 1.57)
    assert np.all(knob[:reach] == 0.0)
    assert np.all(knob[reach : turn - 1] == (0.0, 0.8))
    np.testing.assert_allclose(knob[turn : move - 1], [(turned, 0.8)] * (move - 1 - turn))
    assert np.all(knob[[turn - 1, *range(move - 1, last)]] == turned)


def test_grasped_objects_do_not_move_and_freedoms_have_limits() -> None:
    steps = [Grasp("cabinet", "ball"), PULL, Reach(POSE)]
    problem = make_program(make_full_scene(), steps, options=SHORT)
    assert np.all(get_bounds(problem, "drawer.handle_free") == (-0.6, 0.6))
    for letter in "xyz":
        assert np.all(get_bounds(problem, f"cabinet.ball_{letter}") == (-0.7, 0.6))
    assert np.all(get_bounds(problem, "cabinet.swing") == 0.3)
    slide = get_bounds(problem, "drawer.slide")
    first, last = problem.ends[1:3]
    assert np.all(slide[:first] == 0.0)
    assert np.all(slide[first : last - 1] == (0.0, 0.4))
    assert np.all(slide[last - 1 :] == 0.2)
    lengths = {"base_x", "base_y", "drawer.slide", "cabinet.slide"}
    for name in problem.chain.names:
        assert problem.unit(name) == ("m" if name in lengths else "rad")


def test_robot_stays_within_its_limits_and_the_arena(opening: TrajectoryProblem) -> None:
    robot, scene = opening.scene.robot, opening.scene
    for bound, xy, limits in (
        (opening.lower, scene.arena[::2], robot.lower),
        (opening.upper, scene.arena[1::2], robot.upper),
    ):
        assert (bound[:-1, :2] == xy).all()
        assert np.isinf(bound[:-1, 2]).all()
        assert (bound[:, 3 : len(limits)] == limits[3:]).all()
    narrow = dataclasses.replace(scene, arena=(-50.0, 1.0, -1.0, 60.0))
    problem = make_program(narrow, [Reach(POSE)], options=SHORT)
    assert problem.lower[0, :2].tolist() == [robot.lower[0], -1.0]
    assert problem.upper[0, :2].tolist() == [1.0, robot.upper[1]]
    assert problem.limits("base_x") == (robot.lower[0], 1.0)


def test_base_goal_without_heading_leaves_it_free() -> None:
    problem = make_program(load_door_scene(), [GoTo(-0.5, 0.1)], options=SHORT)
    assert problem.lower[-1, :3].tolist() == [-0.5, 0.1, -np.inf]
    assert problem.upper[-1, :3].tolist() == [-0.5, 0.1, np.inf]


def test_fixed_base_stays_at_the_start() -> None:
    scene = dataclasses.replace(load_door_scene(), robot=load_robot("husky_ur5e", base="fixed"))
    problem = make_program(scene, [Reach(POSE)], options=SHORT)
    for bound in (problem.lower, problem.upper):
        assert (bound[:, :3] == scene.start[:3]).all()


def test_start_is_the_state_of_the_scene() -> None:
    scene = load_door_scene().with_state("door", {"hinge": 0.3, "knob": 0.2})
    scene = scene.with_start(base=[0.1, 0.2, 0.3])
    problem = make_program(scene, [Actuate("door", {"hinge": 1.2})], options=SHORT)
    np.testing.assert_array_equal(problem.start[: len(scene.start)], scene.start)
    assert problem.start[problem.chain.index("door.hinge")] == 0.3
    # the latch does not hold an open door
    assert [phase.segments for phase in problem.task.phases] == [REACH, MOVE]
    assert np.all(get_bounds(problem, "door.knob") == 0.2)


def test_problem_is_immutable(opening: TrajectoryProblem) -> None:
    for array in (opening.start, opening.lower, opening.upper):
        with pytest.raises(ValueError, match="read-only"):
            array[:1] = 0.0
    lower, upper = opening.lower.copy(), opening.upper.copy()
    lower[:, :3] = upper[:, :3] = opening.start[:3]
    fixed_base, moved = opening.with_bounds(lower, upper), opening.still + 0.5
    np.testing.assert_array_equal(fixed_base.clip(moved)[:, :3], opening.still[:, :3])
    assert np.all(opening.clip(moved)[:-1, :3] > opening.still[:-1, :3])


# --- pose goals
# ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("holds", "steps", "waypoints", "stops"),
    [
        (
            [],
            [Actuate("door", {"hinge": 1.2}), GoTo(0.0, 0.0)],
            {"closure door": range(REACH, OPEN + 1), "approach door.handle": [REACH - APPROACH]},
            (REACH, OPEN),
        ),
        ([HANDLE], [Actuate("door", {"knob": 0.3})], {"closure door": range(1, MOVE + 1)}, ()),
        ([], [Reach(POSE, frame="forearm_link")], {"goal forearm_link": [REACH]}, ()),
        (
            [],
            [Grasp("cabinet", "ball"), PULL, Reach(POSE)],
            {
                "closure cabinet": [REACH],
                "closure drawer": range(2 * REACH, 2 * REACH + MOVE + 1),
                "approach cabinet.ball": [REACH - APPROACH],
                "approach drawer.handle_free": [2 * REACH - APPROACH],
                "goal tool": [3 * REACH + MOVE],
            },
            (REACH, 2 * REACH, 2 * REACH + MOVE),
        ),
    ],
    ids=["door", "held door", "frame of the robot", "two grasps"],
)
def test_pose_goals_hold_at_their_waypoints(
    holds: list[Hold],
    steps: list[Step],
    waypoints: dict[str, Sequence[int]],
    stops: tuple[int, ...],
) -> None:
    """Closures hold from the grasp to the release; the robot stops at both."""
    scene = dataclasses.replace(make_full_scene(), holds=tuple(holds))
    problem = make_program(scene, steps, options=SHORT)
    structure, model = problem.transcription.structure, problem.chain.model
    goals = problem.pose_goals
    assert {goal.name: [*goal.row.waypoints] for goal in goals} == {
        name: [*at] for name, at in waypoints.items()
    }
    assert (structure.poses, structure.stops) == (tuple(goal.row for goal in goals), stops)
    closures = {hold.object: closure for hold, closure in problem.chain.closures.items()}
    for goal in goals:
        if goal.object is None:
            frame = model.frames[model.getFrameId(goal.about)]
            expected = frame.parentJoint, frame.placement, POSE
        else:
            closure, placed = closures[goal.object], scene.objects[goal.object]
            expected = closure.joint, closure.local, placed.placement
        assert (goal.row.joint, goal.local, goal.target) == expected


def test_pose_error_and_drift_equal_their_definitions(opening: TrajectoryProblem) -> None:
    """Pose error is the largest residual at goals; drift is measured between waypoints."""
    z, solvers = sample_path(opening), opening.pose_solvers
    path = opening.waypoints(z)
    at_goals = [
        np.abs(solver.evaluate(path[list(goal.row.waypoints)], goal.target)[0]).max()
        for goal, solver in zip(opening.pose_goals, solvers, strict=True)
    ]
    assert opening.pose_error(z) == max(at_goals)
    first, last = opening.ends[[0, 2]]
    middle = (path[first:last] + path[first + 1 : last + 1]) / 2
    residual = solvers[0].evaluate(middle, opening.targets[0])[0].reshape(-1, 2, 3)
    allowed = [Tolerances().closure_position, Tolerances().closure_angle]
    drifts = np.linalg.norm(residual, axis=2) / allowed
    assert opening.drift(z) == pytest.approx(drifts.max(), rel=1e-6)
    alone = make_program(load_door_scene(), [GoTo(0.0, 0.0)], options=SHORT)
    assert alone.pose_error(sample_path(alone)) == alone.drift(sample_path(alone)) == 0.0


@pytest.mark.parametrize(
    ("step", "make_scene"),
    [
        (Actuate("door", {"hinge": 1.2}), load_door_scene),
        (Grasp("cabinet", "socket"), make_full_scene),
        (Grasp("stick"), lambda: make_room(describe_table())),
        (Grasp("ball", "pull", "stick.tip"), make_scene_with_held_stick),
    ],
    ids=["door", "socket with a standoff", "stick", "ball at the stick"],
)
def test_hand_or_holder_approaches_a_grasp_in_a_straight_line(
    step: Step, make_scene: Callable[[], Scene]
) -> None:
    """The goal of the grasp is shifted by `approach` along the holder, fixed in its frame."""
    problem = make_program(make_scene(), [step], options=SHORT)
    (hold,), chain, scene = problem.task.phases[0].grasps, problem.chain, problem.scene
    goals = {goal.kind: goal for goal in problem.pose_goals}
    grasp, approach = goals.get("closure") or goals["grasp"], goals["approach"]
    assert dataclasses.replace(approach.row, shift=None, waypoints=grasp.row.waypoints) == grasp.row
    assert approach.target == grasp.target
    assert approach.row.shift is not None
    data, (joint, vector) = chain.model.createData(), approach.row.shift
    pin.forwardKinematics(chain.model, data, chain.coordinates.q(problem.start))
    holder = scene.tool_placement()
    if hold.by:
        carrier, local = chain.frame("tip", hold.by)
        holder = data.oMi[carrier] * local
    moved = data.oMi[joint].rotation @ np.array(vector)
    np.testing.assert_allclose(moved, SHORT.approach * holder.rotation[:, 2], atol=1e-9)


# --- free objects
# ------------------------------------------------------------------------------------------------


def test_free_objects_are_grasped_at_their_resting_poses() -> None:
    aside = lift(STICK, [0.0, 0.5, 0.0])
    steps = [
        Touch("stick.tip", (0.8, 0.9, 0.7)),
        Place("stick", aside),
        GoTo(0.0, 0.0),
        Grasp("stick"),
    ]
    problem = make_program(make_room(describe_table()), steps, options=SHORT)
    ends = problem.ends.tolist()
    point = pin.SE3(np.eye(3), np.array([0.8, 0.9, 0.7]))
    assert [(g.name, g.target, g.row.waypoints, g.row.kind) for g in problem.pose_goals] == [
        ("grasp stick.grip", STICK, (ends[0],), "pose"),
        ("grasp stick.grip", aside, (ends[4],), "pose"),
        ("approach stick.grip", STICK, (ends[0] - APPROACH,), "pose"),
        ("goal stick.tip", point, (ends[1],), "point"),
        ("goal stick.stick", aside, (ends[2],), "pose"),
        ("approach stick.grip", aside, (ends[4] - APPROACH,), "pose"),
    ]
    structure = problem.transcription.structure
    assert structure.stops == (ends[0], ends[2])
    assert set(structure.clamped) == {
        (problem.chain.index(f"stick.grip_{name}"), grasp - APPROACH, last)
        for name in ("turn", "slide")
        for grasp, last in ((ends[0], ends[2]), (ends[4], ends[4]))
    }
    assert not any(problem.is_closed(phase) for phase in problem.task.phases)


def test_initially_held_object_stays_in_the_hand() -> None:
    """Clamped freedoms keep the scene's values until the release."""
    steps = [Grasp("ball", "pull", "stick.tip"), Place("ball", (0.8, 0.6, 0.7)), Release("stick")]
    scene = make_scene_with_held_stick()
    problem = make_program(scene, [*steps, GoTo(0.0, 0.0)], options=SHORT)
    assert [(goal.name, goal.row.kind) for goal in problem.pose_goals] == [
        ("grasp ball.pull by stick.tip", "pose"),
        ("approach ball.pull by stick.tip", "pose"),
        ("goal ball.ball", "upright"),
    ]
    until = problem.ends[1]
    for name, value, limit in (("slide", 0.02, 0.095), ("turn", -0.1, 1.2)):
        bounds = get_bounds(problem, f"stick.grip_{name}")
        assert problem.start[problem.chain.index(f"stick.grip_{name}")] == value
        assert np.all(bounds[:until] == value)
        assert np.all(bounds[until:] == (-limit, limit))
    chosen = [problem.chain.index(f"ball.pull_{axis}") for axis in "zyx"]
    assert problem.choices == tuple((column, REACH, 2 * REACH) for column in chosen)
    # they change only while grasping, at negligible cost
    weight = 1e-4 * problem.options.velocity_weight_object
    np.testing.assert_allclose(problem.motion_cost.metric[chosen], weight, rtol=1e-12)


def test_loose_grasps_are_not_clamped() -> None:
    steps = [Actuate("cabinet", {"swing": 0.5}, "sleeve")]
    assert make_program(make_full_scene(), steps, options=SHORT).choices == ()


@pytest.mark.parametrize("waypoints", [1, 3, 10])
def test_grasps_are_chosen_within_their_own_phases(waypoints: int) -> None:
    """The freedoms of an earlier grasp do not bind a later one, however short the phases are."""
    aside = Place("stick", pin.SE3(np.eye(3), np.array([2.5, 0.5, 0.771])))
    options = Options(reach_waypoints=waypoints)
    problem = make_program(load_scene("init_1"), [aside, Grasp("stick")], options=options)
    clamped = problem.transcription.structure.clamped
    one, other = sorted({(first, last) for _, first, last in clamped})
    assert one[1] < other[0]
    assert any(goal.kind == "approach" for goal in problem.pose_goals) == (waypoints > 1)


# --- rows and rates
# ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [0.01, 3.0])
def test_rate_violation_equals_that_of_the_trajectory(
    opening: TrajectoryProblem, scale: float
) -> None:
    z, timing = sample_path(opening, scale), opening.timing_for(opening.still)
    trajectory, chain = make_trajectory(opening, z, timing.dt), opening.chain
    velocity = np.abs(trajectory.velocities()) / chain.velocity
    acceleration = np.abs(trajectory.accelerations()) / chain.acceleration
    expected = max(velocity.max(), acceleration.max()) - 1.0
    assert timing.compute_violation(*opening.rates(z, timing.dt)) == pytest.approx(
        expected, rel=1e-9
    )


def test_repr_names_phases_and_sizes(opening: TrajectoryProblem) -> None:
    phases = "reach door.handle → turn door.knob → move door.hinge, door.knob → go to"
    assert f"{phases}: {opening.segments} steps" in repr(opening)


def test_joint_cannot_be_grasped_twice() -> None:
    with pytest.raises(InputError, match="two grasps of one joint"):
        make_program(load_door_scene(), [Grasp("door", "handle"), Grasp("door", "handle_free")])
