"""Tests the program of a task: bounds, pose goals, rates and rows."""

from __future__ import annotations

import dataclasses
import itertools

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import STICK, lifted, room, stand, table
from helpers.relaxed import check_relaxation, iterates
from helpers.small_problems import SHORT, door_scene, full_scene, program_of, random_configurations

import vkc_pin as vkc
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.options import Options
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.solver.to_trajectory import make_trajectory
from vkc_pin.world.models.robot_file import load_robot
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import load_scene
from vkc_pin.world.task.compiler import LATCH_MARGIN
from vkc_pin.world.task.steps import Actuate, GoTo, Grasp, Place, Reach, Release, Step, Touch
from vkc_pin.world.task.terms import Constraint

POSE = pin.SE3(pin.rpy.rpyToMatrix(0.3, -2.0, 0.7), np.array([0.4, 0.2, 0.9]))
HANDLE = Hold("door", "handle")
REACH, TURN, MOVE = SHORT.reach_waypoints, SHORT.turn_waypoints, SHORT.move_waypoints


@pytest.fixture(scope="module")
def opened() -> TrajectoryProblem:
    return program_of(
        door_scene(), [Actuate("door", {"hinge": 1.2}), GoTo(-0.5, 0.1, -2.2)], options=SHORT
    )


@pytest.fixture(scope="module")
def two_grasps() -> TrajectoryProblem:
    steps: list[Step] = [
        Grasp("cabinet", "ball"),
        Actuate("drawer", {"slide": 0.2}, attachment="handle_free"),
        Reach(POSE),
    ]
    return program_of(full_scene(), steps, options=SHORT)


def column(problem: TrajectoryProblem, name: str) -> np.ndarray:
    """Return the bounds of a coordinate at each waypoint after the start, shape (N, 2)."""
    index = problem.chain.index(name)
    return np.column_stack([problem.lower[:, index], problem.upper[:, index]])


def random_path(problem: TrajectoryProblem, seed: int = 0, scale: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    far = random_configurations(problem.chain.lower, problem.chain.upper, problem.segments, rng)
    return problem.start + scale * (far - problem.start)


def names_of(problem: TrajectoryProblem) -> list[str]:
    return [goal.name for goal in problem.pose_goals]


# --- bounds
# ------------------------------------------------------------------------------------------------


def test_phases_follow_one_another(opened: TrajectoryProblem) -> None:
    assert [phase.segments for phase in opened.task.phases] == [REACH, TURN, MOVE, REACH]
    np.testing.assert_array_equal(opened.ends, np.cumsum([REACH, TURN, MOVE, REACH]))
    assert opened.segments == opened.ends[-1] == opened.transcription.segments
    assert opened.lower.shape == opened.upper.shape == (opened.segments, opened.chain.size)
    assert np.all(opened.lower <= opened.upper)


def test_objects_joints_stand_still_until_they_are_moved(opened: TrajectoryProblem) -> None:
    turned = 0.5 + LATCH_MARGIN
    reach, turn, move, _ = opened.ends.tolist()
    hinge, knob = column(opened, "door.hinge"), column(opened, "door.knob")
    assert np.all(hinge[:turn] == 0.0)
    assert np.all(hinge[turn : move - 1] == (-1.57, 1.57))
    assert np.all(hinge[move - 1 :] == 1.2)
    assert np.all(knob[:reach] == 0.0)
    assert np.all(knob[reach : turn - 1] == (0.0, 0.8))
    assert np.all(knob[turn - 1] == turned)
    np.testing.assert_allclose(knob[turn : move - 1], [(turned, 0.8)] * (move - 1 - turn))
    assert np.all(knob[move - 1 :] == turned)


def test_a_goal_beyond_a_limit_is_approached_as_far_as_it_goes() -> None:
    problem = program_of(
        door_scene(), [Actuate("door", {"hinge": 2.0}), GoTo(0.0, 0.0)], options=SHORT
    )
    hinge = column(problem, "door.hinge")
    assert np.all(hinge[problem.ends[2] - 1 :] == 1.57)
    panel = next(
        i
        for i, label in enumerate(problem.contacts.phases[3].labels)
        if label == "door.panel" and i > 20
    )
    part = problem.contacts.phases[3]
    assert part.joint[panel] == 0
    expected = door_scene().objects["door"].with_state({"hinge": 1.57}).link_placement("panel")
    np.testing.assert_allclose(part.shapes[panel].placement.rotation, expected.rotation, atol=1e-9)


def test_the_robot_keeps_its_limits_and_stays_in_the_arena(opened: TrajectoryProblem) -> None:
    robot, scene = opened.scene.robot, opened.scene
    inner = slice(0, opened.segments - 1)  # the last waypoint has the base's goal
    x_min, x_max, y_min, y_max = scene.arena
    np.testing.assert_array_equal(
        opened.lower[inner, :2], np.tile([x_min, y_min], (opened.segments - 1, 1))
    )
    np.testing.assert_array_equal(
        opened.upper[inner, :2], np.tile([x_max, y_max], (opened.segments - 1, 1))
    )
    assert np.all(np.isinf(opened.lower[inner, 2]))
    arm = slice(3, robot.coordinates.size)
    np.testing.assert_array_equal(
        opened.lower[:, arm], np.tile(robot.lower[arm], (opened.segments, 1))
    )
    np.testing.assert_array_equal(
        opened.upper[:, arm], np.tile(robot.upper[arm], (opened.segments, 1))
    )
    narrow = dataclasses.replace(scene, arena=(-50.0, 1.0, -1.0, 60.0))
    problem = program_of(narrow, [Reach(POSE)], options=SHORT)
    np.testing.assert_array_equal(problem.lower[0, :2], [robot.lower[0], -1.0])
    np.testing.assert_array_equal(problem.upper[0, :2], [1.0, robot.upper[1]])
    assert problem.limits("base_x") == (robot.lower[0], 1.0)


@pytest.mark.parametrize("start", [2.2, -2.2 - 2 * np.pi, 15.0])
def test_the_base_goes_to_its_goal_by_the_nearest_heading(start: float) -> None:
    scene = door_scene().with_start(base=[-0.7, 0.3, start])
    problem = program_of(scene, [GoTo(-0.5, 0.1, -2.2)], options=SHORT)
    np.testing.assert_array_equal(problem.lower[-1, :3], problem.upper[-1, :3])
    np.testing.assert_array_equal(problem.lower[-1, :2], [-0.5, 0.1])
    heading = problem.lower[-1, 2]
    assert np.cos(heading + 2.2) == pytest.approx(1.0)
    assert abs(heading - start) <= np.pi + 1e-9


def test_a_goal_without_heading_leaves_it_open() -> None:
    problem = program_of(door_scene(), [GoTo(-0.5, 0.1)], options=SHORT)
    np.testing.assert_array_equal(problem.lower[-1, :2], problem.upper[-1, :2])
    assert (problem.lower[-1, 2], problem.upper[-1, 2]) == (-np.inf, np.inf)


def test_a_fixed_base_stays_where_it_stands() -> None:
    scene = dataclasses.replace(door_scene(), robot=load_robot("husky_ur5e", base="fixed"))
    problem = program_of(scene, [Reach(POSE)], options=SHORT)
    for bound in (problem.lower, problem.upper):
        np.testing.assert_array_equal(bound[:, :3], np.tile(scene.start[:3], (problem.segments, 1)))
    for k, name in enumerate(("base_x", "base_y", "base_yaw")):
        assert problem.limits(name) == (scene.start[k], scene.start[k])


def test_the_hands_freedom_in_a_grasp_has_its_limits(two_grasps: TrajectoryProblem) -> None:
    assert np.all(column(two_grasps, "drawer.handle_free") == (-0.6, 0.6))
    for letter in "xyz":
        assert np.all(column(two_grasps, f"cabinet.ball_{letter}") == (-0.7, 0.6))


def test_objects_that_are_only_grasped_do_not_move(two_grasps: TrajectoryProblem) -> None:
    assert np.all(column(two_grasps, "cabinet.swing") == 0.3)
    assert np.all(column(two_grasps, "cabinet.slide") == 0.1)
    slide = column(two_grasps, "drawer.slide")
    first, last = two_grasps.ends[1], two_grasps.ends[2]
    assert np.all(slide[:first] == 0.0)
    assert np.all(slide[first : last - 1] == (0.0, 0.4))
    assert np.all(slide[last - 1 :] == 0.2)


def test_start_is_that_of_the_scene() -> None:
    scene = (
        door_scene()
        .with_state("door", {"hinge": 0.3, "knob": 0.2})
        .with_start(base=[0.1, 0.2, 0.3])
    )
    problem = program_of(scene, [Actuate("door", {"hinge": 1.2})], options=SHORT)
    np.testing.assert_array_equal(problem.start[: len(scene.start)], scene.start)
    assert problem.start[problem.chain.index("door.hinge")] == 0.3
    assert problem.start[problem.chain.index("door.knob")] == 0.2
    # Beyond the latch's reach nothing need be turned.
    assert [phase.segments for phase in problem.task.phases] == [REACH, MOVE]
    assert np.all(column(problem, "door.knob") == 0.2)


def test_clip_and_waypoints(opened: TrajectoryProblem) -> None:
    wild = 100.0 * np.random.default_rng(0).normal(size=(opened.segments, opened.chain.size))
    clipped = opened.clip(wild)
    assert np.all((clipped >= opened.lower) & (clipped <= opened.upper))
    inside = (wild >= opened.lower) & (wild <= opened.upper)
    np.testing.assert_array_equal(clipped[inside], wild[inside])
    path = opened.waypoints(clipped)
    np.testing.assert_array_equal(path[0], opened.start)
    np.testing.assert_array_equal(path[1:], clipped)


# --- poses
# ------------------------------------------------------------------------------------------------


def test_closure_holds_from_the_grasp_to_the_end_of_the_hold(opened: TrajectoryProblem) -> None:
    reach, _, move, _ = opened.ends.tolist()
    assert names_of(opened) == ["closure door", "approach door.handle"]
    pose, _ = opened.transcription.structure.poses
    assert pose.waypoints == tuple(range(reach, move + 1))
    closure = opened.chain.closures[HANDLE]
    assert (pose.joint, pose.local) == (closure.joint, closure.local)
    assert opened.targets == (opened.scene.objects["door"].placement,) * 2


def test_every_object_is_closed_while_it_is_held_and_goals_are_met_at_the_end(
    two_grasps: TrajectoryProblem,
) -> None:
    first, second, third, fourth = two_grasps.ends.tolist()
    at = dict(
        zip(
            names_of(two_grasps),
            (p.waypoints for p in two_grasps.transcription.structure.poses),
            strict=True,
        )
    )
    way = SHORT.steps(SHORT.approach_time)
    assert at == {
        "approach cabinet.ball": (first - way,),
        "approach drawer.handle_free": (second - way,),
        "closure cabinet": (first,),
        "closure drawer": tuple(range(second, third + 1)),
        f"goal {two_grasps.scene.robot.tool_frame}": (fourth,),
    }
    targets = dict(zip(names_of(two_grasps), two_grasps.targets, strict=True))
    assert targets["closure cabinet"] == two_grasps.scene.objects["cabinet"].placement
    assert targets["closure drawer"] == two_grasps.scene.objects["drawer"].placement
    assert two_grasps.targets[-1] == POSE
    assert two_grasps.target_matrix().shape == (5, 12)
    assert two_grasps.transcription.structure.stops == (first, second, third)


def test_what_is_held_at_the_start_is_closed_from_the_first_waypoint() -> None:
    scene = dataclasses.replace(door_scene(), holds=(HANDLE,))
    problem = program_of(scene, [Actuate("door", {"knob": 0.3})], options=SHORT)
    assert [phase.held for phase in problem.task.phases] == [(HANDLE,)]
    assert problem.transcription.structure.poses[0].waypoints == tuple(range(1, MOVE + 1))
    assert problem.transcription.structure.stops == ()


def test_a_frame_of_the_robot_can_reach_too() -> None:
    problem = program_of(door_scene(), [Reach(POSE, frame="forearm_link")], options=SHORT)
    frame = problem.chain.model.frames[problem.chain.model.getFrameId("forearm_link")]
    (pose,) = problem.transcription.structure.poses
    assert (names_of(problem), pose.joint, pose.waypoints) == (
        ["goal forearm_link"],
        frame.parentJoint,
        (REACH,),
    )
    assert pose.local == frame.placement


def test_pose_error_and_drift(opened: TrajectoryProblem) -> None:
    """Pose error is the largest residual at goals; drift is measured between held waypoints."""
    z = random_path(opened)
    poses, model = opened.transcription.structure.poses, opened.chain.model
    data = opened.chain.model.createData()
    assert len(poses) == len(opened.targets) == 2

    def residual(row: np.ndarray, number: int = 0) -> np.ndarray:
        pose, target = poses[number], opened.targets[number]
        pin.forwardKinematics(model, data, opened.chain.coordinates.q(row))
        at = data.oMi[pose.joint] * pose.local
        if pose.shift is not None:
            at.translation = at.translation + data.oMi[pose.shift[0]].rotation @ np.array(
                pose.shift[1]
            )
        turn = pin.log3(target.rotation.T @ at.rotation)
        angle = np.linalg.norm(turn)
        return np.abs(
            np.r_[at.translation - target.translation, 2 * np.sin(angle / 2) * turn / angle]
        )

    path = opened.waypoints(z)
    worst = max(
        residual(path[t], number).max() for number, pose in enumerate(poses) for t in pose.waypoints
    )
    assert opened.pose_error(z) == pytest.approx(worst, abs=1e-8)
    reach, _, move, _ = opened.ends.tolist()
    between = [residual((path[t] + path[t + 1]) / 2) for t in range(reach, move)]
    drifts = [np.linalg.norm(r[:3]) / vkc.Tolerances().closure_position for r in between]
    drifts += [np.linalg.norm(r[3:]) / vkc.Tolerances().closure_angle for r in between]
    assert opened.drift(z) == pytest.approx(max(drifts), rel=1e-6)
    alone = program_of(door_scene(), [GoTo(0.0, 0.0)], options=SHORT)
    assert alone.pose_error(random_path(alone)) == alone.drift(random_path(alone)) == 0.0


def tool(problem: TrajectoryProblem, row: np.ndarray) -> pin.SE3:
    """Return where the tool is at a configuration of the chain."""
    robot = problem.scene.robot
    data = robot.model.createData()
    pin.framesForwardKinematics(
        robot.model, data, robot.coordinates.q(row[: robot.coordinates.size])
    )
    return data.oMf[robot.model.getFrameId(robot.tool_frame)].copy()


@pytest.mark.parametrize(
    ("step", "scene"),
    [
        (Actuate("door", {"hinge": 1.2}), door_scene),
        (Grasp("cabinet", "socket"), full_scene),
        (Grasp("stick"), lambda: room(table())),
    ],
    ids=["door", "socket with a standoff", "stick"],
)
def test_a_hand_comes_straight_to_what_it_grasps(step: Step, scene) -> None:  # type: ignore[no-untyped-def]
    """Before the grasp, the tool is `approach` behind the grasp pose, whatever its freedoms."""
    problem = program_of(scene(), [step], options=SHORT)
    number = next(k for k, name in enumerate(names_of(problem)) if name.startswith("approach "))
    pose, solver, target = (
        part[number]
        for part in (
            problem.transcription.structure.poses,
            problem.transcription.pose_solvers,
            problem.targets,
        )
    )
    assert pose.waypoints == (REACH - SHORT.steps(SHORT.approach_time),)
    (hold,) = problem.task.holds
    placed = problem.scene.objects[hold.object]
    grasp = placed.object.attachments[hold.attachment]
    rng = np.random.default_rng(0)
    seeds = random_configurations(problem.chain.lower, problem.chain.upper, 200, rng, arena=3.0)
    lower, upper = problem.chain.lower.copy(), problem.chain.upper.copy()
    for name, value in problem.task.state.items():
        lower[problem.chain.index(name)] = upper[problem.chain.index(name)] = value
    z, found = solver.solve(
        seeds, target, lower=lower, upper=upper, weights=np.ones(problem.chain.size), iterations=40
    )
    assert found.sum() > 10
    for row in z[found]:
        values = [row[problem.chain.index(f"{hold.object}.{name}")] for name in grasp.coordinates]
        there = placed.link_placement(grasp.link) * grasp.placement * grasp.motion(values)
        behind = there * pin.SE3(np.eye(3), np.array([0.0, 0.0, -SHORT.approach]))
        np.testing.assert_allclose(
            tool(problem, row).homogeneous, behind.homogeneous, rtol=0.0, atol=1e-5
        )


# --- what is carried
# ------------------------------------------------------------------------------------------------

FETCH: list[Step] = [
    Grasp("ball", "pull", "stick.tip"),
    Place("ball", (0.8, 0.6, 0.7)),
    Release("stick"),
    GoTo(0.0, 0.0),
]


@pytest.fixture(scope="module")
def fetching() -> TrajectoryProblem:
    scene = room(stand(), objects=("stick", "ball")).with_held(
        {"stick": "grip"}, at={"stick": (0.02, -0.1)}
    )
    return program_of(scene, FETCH, options=SHORT)


def test_free_objects_are_grasped_where_they_stand_and_closed_nowhere_else() -> None:
    aside = lifted(STICK, [0.0, 0.5, 0.0])
    steps = [
        Touch("stick.tip", (0.8, 0.9, 0.7)),
        Place("stick", aside),
        GoTo(0.0, 0.0),
        Grasp("stick"),
    ]
    problem = program_of(room(table()), steps, options=SHORT)
    ends = problem.ends.tolist()
    at = list(
        zip(names_of(problem), problem.targets, problem.transcription.structure.poses, strict=True)
    )
    found = [(name, target, pose.waypoints, pose.kind) for name, target, pose in at]
    way = SHORT.steps(SHORT.approach_time)
    point = pin.SE3(np.eye(3), np.array([0.8, 0.9, 0.7]))
    assert found == [
        ("grasp stick.grip", STICK, (ends[0],), "pose"),
        ("grasp stick.grip", aside, (ends[4],), "pose"),
        ("approach stick.grip", STICK, (ends[0] - way,), "pose"),
        ("goal stick.tip", point, (ends[1],), "point"),
        ("goal stick.stick", aside, (ends[2],), "pose"),
        ("approach stick.grip", aside, (ends[4] - way,), "pose"),
    ]
    assert problem.transcription.structure.stops == (ends[0], ends[2])
    assert not any(problem.closed(phase) for phase in problem.task.phases)


def test_initially_held_object_stays_in_the_hand(fetching: TrajectoryProblem) -> None:
    """The values at which it is clamped are the scene's, until it is let go of."""
    problem = fetching
    assert [str(hold) for hold in problem.scene.holds] == ["stick.grip"]
    for name, value in (("stick.grip_slide", 0.02), ("stick.grip_turn", -0.1)):
        assert problem.start[problem.chain.index(name)] == value
        until = problem.ends[1]  # there both are let go of
        assert np.all(column(problem, name)[:until] == value)
        freedom = (-0.095, 0.095) if name.endswith("slide") else (-1.2, 1.2)
        assert np.all(column(problem, name)[until:] == freedom)
    for axis in "xyz":
        assert np.all(column(problem, f"ball.pull_{axis}") == (-np.pi, np.pi))
    assert problem.choices == tuple(
        (problem.chain.index(f"ball.pull_{a}"), REACH, 2 * REACH) for a in "zyx"
    )
    chosen = [
        column for column, _, _ in problem.choices
    ]  # what is clamped changes while grasping only, at next to no cost
    np.testing.assert_allclose(
        problem.motion_cost.metric[chosen],
        1e-4 * problem.options.velocity_weight_object,
        rtol=1e-12,
    )


def test_a_loose_grasp_is_not_clamped() -> None:
    problem = program_of(
        full_scene(), [Actuate("cabinet", {"swing": 0.5}, "sleeve")], options=SHORT
    )
    assert problem.choices == ()
    assert problem.transcription.structure.clamped == ()


def test_what_is_held_through_something_is_closed_by_its_holder(
    fetching: TrajectoryProblem,
) -> None:
    """The pose of the grasp is that of the tip, and the goal that of the ball on it."""
    poses = dict(zip(names_of(fetching), fetching.transcription.structure.poses, strict=True))
    assert list(poses) == [
        "grasp ball.pull by stick.tip",
        "approach ball.pull by stick.tip",
        "goal ball.ball",
    ]
    assert poses["goal ball.ball"].kind == "upright"
    (row,) = random_configurations(
        fetching.chain.lower, fetching.chain.upper, 1, np.random.default_rng(0)
    )
    data, model = fetching.chain.model.createData(), fetching.chain.model
    pin.forwardKinematics(model, data, fetching.chain.coordinates.q(row))
    pose = poses["approach ball.pull by stick.tip"]
    assert pose.shift is not None
    tip_joint, tip = fetching.chain.frame("tip", fetching.task.holds[0])
    direction = (data.oMi[tip_joint] * tip).rotation[:, 2]
    np.testing.assert_allclose(
        data.oMi[pose.shift[0]].rotation @ np.array(pose.shift[1]),
        SHORT.approach * direction,
        atol=1e-9,
    )


# --- what is not of one waypoint alone
# --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def carrying() -> TrajectoryProblem:
    """Return a problem with a rolling base, a clamped grasp and user-defined constraints."""
    scene = dataclasses.replace(room(table()), robot=load_robot("husky_ur5e", base="differential"))
    terms = [
        Constraint(
            "tip",
            lambda s: s.position("stick.tip"),
            lower=[-0.1, -0.2, 0.0],
            upper=0.3,
            tolerance=0.02,
        ),
        Constraint(
            "level",
            lambda s: s.rotation("stick.stick")[2, :2].T,
            lower=0.0,
            upper=0.0,
            during="place stick",
        ),
        Constraint(
            "slow", lambda s: ca.norm_2(s.velocity("tool")) ** 2, upper=0.5, tolerance=0.004
        ),
    ]
    steps = [Touch("stick.tip", (0.8, 0.9, 0.7)), Place("stick", (0.8, 0.5, 0.56))]
    return program_of(scene, steps, options=SHORT, terms=terms)


def test_excess_is_the_signed_bound_violation(carrying: TrajectoryProblem) -> None:
    """The sign points away from the bound; values within bounds have no excess."""
    p, t = carrying, carrying.transcription
    dt = np.random.default_rng(1).uniform(0.1, 0.4, p.segments)
    for seed, scale in ((0, 1.0), (1, 0.1), (2, 5.0)):
        z = random_path(p, seed, scale)
        timing = dataclasses.replace(p.timing_for(z), dt=dt)
        rates = seed == 0  # then the wheels have limits, too
        bounds = p.row_bounds(timing if rates else None)
        found, lower, upper = (
            p.excess(z, timing, rates=rates),
            *(bound[t.first_relaxed_row : t.rows] for bound in bounds),
        )
        assert found.shape == (t.rows - t.first_relaxed_row,)
        values = np.full(t.rows, np.nan)
        path = p.waypoints(z)
        step, heading = np.diff(path[:, :2], axis=0), (path[1:, 2] + path[:-1, 2]) / 2
        along, aside = (
            (np.exp(-1j * heading) * (step[:, 0] + 1j * step[:, 1])).view(float).reshape(-1, 2).T
        )
        arm, turn = p.chain.robot.wheels.track / 2, np.diff(path[:, 2])
        values[t.base_rows] = np.column_stack(
            [aside, along - arm * turn, along + arm * turn]
        ).ravel()
        steps = [
            (column, k)
            for column, first, last in t.structure.clamped
            for k in range(first + 1, last + 1)
        ]
        clamped = np.flatnonzero(p.row_kinds["clamped"]) + t.first_relaxed_row
        values[clamped] = [path[k, column] - path[k - 1, column] for column, k in steps]
        values[p.term_evaluator.rows] = np.asarray(t.term_values(t.pack(z), p.start, dt)[0]).ravel()
        values = values[t.first_relaxed_row :]
        assert np.isfinite(values).all()
        np.testing.assert_allclose(
            np.clip(values - found, lower, upper), values - found, rtol=0.0, atol=1e-12
        )
        inside = (values >= lower) & (values <= upper)
        np.testing.assert_array_equal(found[inside], np.zeros(inside.sum()))
        low, high = values < lower - 1e-9, values > upper + 1e-9
        np.testing.assert_allclose(found[low], (values - lower)[low], rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(found[high], (values - upper)[high], rtol=0.0, atol=1e-12)
        if scale == 1.0:
            assert low.any()
            assert high.any()
            assert inside.any()
        equal = lower == upper
        np.testing.assert_allclose(found[equal], values[equal], rtol=0.0, atol=1e-12)


def test_program_with_only_waypoint_rows_has_no_excess(opened: TrajectoryProblem) -> None:
    z = random_path(opened)
    assert opened.excess(z, opened.timing_for(z)).shape == (0,)
    assert all(of.shape == (0,) for of in opened.row_kinds.values())


def test_every_row_of_several_waypoints_is_of_one_kind(carrying: TrajectoryProblem) -> None:
    p, t, count = (
        carrying,
        carrying.transcription,
        carrying.transcription.rows - carrying.transcription.first_relaxed_row,
    )
    assert set(p.row_kinds) == {"rolling", "clamped", "terms"}
    assert all(of.shape == (count,) and (of >= 0.0).all() for of in p.row_kinds.values())
    np.testing.assert_array_equal(
        sum((of > 0.0).astype(int) for of in p.row_kinds.values()), np.ones(count, int)
    )
    np.testing.assert_array_equal(
        np.flatnonzero(p.row_kinds["rolling"]) + t.first_relaxed_row, t.base_rows
    )
    assert len(t.base_rows) == 3 * p.segments, "not aside, and no faster than either wheel"
    clamped = sum(last - first for _, first, last in t.structure.clamped)
    assert np.count_nonzero(p.row_kinds["clamped"]) == clamped > 0
    np.testing.assert_array_equal(
        np.flatnonzero(p.row_kinds["terms"]) + t.first_relaxed_row, p.term_evaluator.rows
    )
    for kind in ("rolling", "clamped"):
        assert set(p.row_kinds[kind]) == {0.0, 1.0}
    # Of own constraints 1e-3 is the tolerance.
    tolerances = {"tip": 0.02, "level": 1e-3, "slow": 0.004}
    for term, at in zip(p.terms, t.term_rows, strict=True):
        for rows in at.values():
            np.testing.assert_allclose(
                p.row_kinds["terms"][rows - t.first_relaxed_row], 1e-3 / tolerances[term.name]
            )


def test_rows_of_several_waypoints_belong_to_the_last_of_them(carrying: TrajectoryProblem) -> None:
    p, t = carrying, carrying.transcription
    owner = np.full(t.rows, -1)
    owner[t.base_rows] = np.repeat(np.arange(p.segments), 3)
    steps = [k for _, first, last in t.structure.clamped for k in range(first + 1, last + 1)]
    owner[np.flatnonzero(p.row_kinds["clamped"]) + t.first_relaxed_row] = np.array(steps) - 1
    for at in t.term_rows:
        for waypoint, rows in at.items():
            owner[rows] = waypoint - 1
    np.testing.assert_array_equal(t.row_waypoints, owner[t.first_relaxed_row :])


def test_a_program_with_all_kinds_of_rows_is_feasible_where_it_is_set_up(
    carrying: TrajectoryProblem,
) -> None:
    missing = [check_relaxation(carrying, z) for z in iterates(carrying)]
    for kind in ("clearance", "poses", "rolling", "clamped", "terms", "rates"):
        assert max(each[kind] for each in missing) > 0.1, kind


# --- rates
# ------------------------------------------------------------------------------------------------


def test_rates_are_those_of_the_trajectory(two_grasps: TrajectoryProblem) -> None:
    """Rates include the pauses of the gripper; freedoms of open hands do not matter."""
    z, dt = random_path(two_grasps), SHORT.dt
    trajectory = make_trajectory(two_grasps, z, np.full(two_grasps.segments, dt))
    steps, changes = two_grasps.rates(z)
    assert steps.shape == (two_grasps.segments, two_grasps.chain.size)
    assert changes.shape == (
        two_grasps.segments + 1 + len(two_grasps.transcription.structure.stops),
        two_grasps.chain.size,
    )
    velocities = trajectory.velocities()
    moving = np.isclose(np.diff(trajectory.times), dt)
    assert np.all(velocities[~moving] == 0.0)
    assert (~moving).sum() >= 1
    choices = [
        two_grasps.chain.index(name)
        for names in two_grasps.chain.virtual.values()
        for name in names
    ]
    others = np.setdiff1d(np.arange(two_grasps.chain.size), choices)
    assert len(choices) == 4
    np.testing.assert_allclose(
        (velocities[moving] * dt)[:, others], steps[:, others], rtol=0.0, atol=1e-10
    )
    held, slides = (
        slice(two_grasps.ends[1], two_grasps.ends[2]),
        two_grasps.chain.index("drawer.handle_free"),
    )
    assert np.all(steps[held, slides] != 0.0)
    np.testing.assert_allclose(
        (velocities[moving] * dt)[held, slides], steps[held, slides], rtol=0.0, atol=1e-10
    )
    assert np.all(velocities[moving][: held.start, slides] == 0.0)
    accelerations = trajectory.accelerations() * dt**2
    # Two rows stand for a waypoint of rest, the stop and the start; with a pause there they are two
    # waypoints.
    assert len(accelerations) == len(changes)
    np.testing.assert_allclose(accelerations[:, others], changes[:, others], rtol=0.0, atol=1e-10)


def test_bounds_on_rates_are_the_limits(two_grasps: TrajectoryProblem) -> None:
    """One row for each row of rates."""
    p = two_grasps
    steps, changes = p.rates(random_path(p))
    timing = p.timing_for(p.still)
    np.testing.assert_array_equal(timing.dt, np.full(p.segments, SHORT.dt))
    np.testing.assert_allclose(
        timing.velocity, np.tile(p.chain.velocity * SHORT.dt, (len(steps), 1))
    )
    np.testing.assert_allclose(
        timing.acceleration, np.tile(p.chain.acceleration * SHORT.dt**2, (len(changes), 1))
    )
    assert np.all(timing.velocity > 0)


@pytest.mark.parametrize("scale", [0.01, 0.5, 3.0])
def test_rate_violation_is_the_worst_excess(two_grasps: TrajectoryProblem, scale: float) -> None:
    z = random_path(two_grasps, scale=scale)
    timing = two_grasps.timing_for(two_grasps.still)
    trajectory = make_trajectory(two_grasps, z, timing.dt)
    velocity = np.abs(trajectory.velocities()) / two_grasps.chain.velocity
    acceleration = np.abs(trajectory.accelerations()) / two_grasps.chain.acceleration
    expected = max(velocity.max(), acceleration.max()) - 1.0
    assert timing.compute_violation(*two_grasps.rates(z)) == pytest.approx(expected, rel=1e-9)


def runs(problem: TrajectoryProblem) -> list[slice]:
    """Return the steps between two rests."""
    stops = [0, *problem.transcription.structure.stops, problem.segments]
    return [slice(a, b) for a, b in itertools.pairwise(stops)]


def test_long_runs_get_more_time() -> None:
    """Only runs that are too long get more time, enough for the profile 3s² − 2s³."""
    problem = program_of(
        full_scene(), [Actuate("door", {"hinge": 1.2}), GoTo(-0.5, 0.1)], options=SHORT
    )
    first, *others = runs(problem)
    z = np.tile(problem.start, (problem.segments, 1))
    share = np.arange(1, first.stop + 1) / first.stop
    z[first, 0] += 30.0 * share**2 * (3 - 2 * share)
    z[first.stop :, 0] += 30.0
    still, timing = problem.timing_for(problem.still), problem.timing_for(z)
    np.testing.assert_array_equal(still.dt, np.full(problem.segments, SHORT.dt))
    assert still.compute_violation(*problem.rates(z)) > 1.0
    assert np.ptp(timing.dt[first]) == 0.0
    assert timing.dt[0] * first.stop > 1.5 * 30.0 / problem.chain.velocity[0]
    for run in others:
        np.testing.assert_array_equal(timing.dt[run], np.full(run.stop - run.start, SHORT.dt))
    assert timing.compute_violation(*problem.rates(z)) <= 0.0
    # The bounds are the limits over the new times, row by row, and the trajectory is played at
    # them.
    np.testing.assert_allclose(timing.velocity, problem.chain.velocity * timing.dt[:, None])
    of_rows = np.concatenate(
        [np.full(run.stop - run.start + 1, timing.dt[run.start]) for run in runs(problem)]
    )
    np.testing.assert_allclose(
        timing.acceleration, problem.chain.acceleration * of_rows[:, None] ** 2
    )
    motion = make_trajectory(problem, z, timing.dt)
    moving = np.abs(np.diff(motion.positions[:, 0])) > 0
    np.testing.assert_allclose(np.diff(motion.times)[moving], timing.dt[first])
    assert np.abs(motion.velocities()[:, 0]).max() <= problem.chain.velocity[0]
    assert np.abs(motion.accelerations()[:, 0]).max() <= problem.chain.acceleration[0]
    assert f"in {still.dt.sum():g} s" in repr(problem)


def test_a_step_that_is_too_fast_gets_more_time_within_reason() -> None:
    problem = program_of(
        full_scene(), [Actuate("door", {"hinge": 1.2}), GoTo(-0.5, 0.1)], options=SHORT
    )
    first, second, *_ = runs(problem)
    for jump, enough in ((0.15, True), (30.0, False)):
        z = problem.still
        z[second.start + 2 :, 3] += jump
        rates, before = problem.rates(z), problem.timing_for(problem.still)
        assert before.compute_violation(*rates) > 0.0
        longer = before.stretch(*rates)
        np.testing.assert_array_equal(before.dt, np.full(problem.segments, SHORT.dt))
        np.testing.assert_array_equal(longer.dt[first], before.dt[first])
        assert np.all(longer.dt[second] > before.dt[second])
        assert np.ptp(longer.dt[second]) == 0.0
        assert (longer.compute_violation(*rates) <= 1e-9) == enough
        assert longer.dt[second.start] <= 2.0 * SHORT.dt  # the rest is left to the solver
        again = longer.stretch(*rates)
        assert np.all(again.dt <= 1.5 * before.dt)  # however often that is asked for


def test_stationary_motion_violates_nothing(opened: TrajectoryProblem) -> None:
    timing = opened.timing_for(opened.still)
    assert timing.compute_violation(*opened.rates(opened.still)) <= 0.0
    assert opened.objective(opened.still, timing.dt) == 0.0


def test_a_problem_does_not_change(opened: TrajectoryProblem) -> None:
    """Other bounds make another problem."""
    for array in (opened.start, opened.lower, opened.upper):
        with pytest.raises(ValueError, match="read-only"):
            array[:1] = 0.0
    lower, upper = opened.lower.copy(), opened.upper.copy()
    lower[:, :3] = upper[:, :3] = opened.start[:3]
    standing = opened.with_bounds(lower, upper)
    np.testing.assert_array_equal(standing.clip(opened.still + 0.5)[:, :3], opened.still[:, :3])
    assert np.all(opened.clip(opened.still + 0.5)[:-1, :3] > opened.still[:-1, :3])


# --- the rest
# ------------------------------------------------------------------------------------------------


def test_contacts_are_those_of_each_waypoints_phase(opened: TrajectoryProblem) -> None:
    z = opened.clip(np.nan_to_num(random_path(opened, scale=0.3)))
    contacts = opened.evaluate_contacts(z, reach=0.3, nearest=5)
    assert np.bincount(contacts.waypoint).max() == 5
    held = opened.chain.held_geometries[HANDLE]
    begin, end = opened.ends[0], opened.ends[2]
    for row, pair in zip(contacts.waypoint, contacts.pair, strict=True):
        if not begin <= row < end:  # row t belongs to waypoint t + 1
            assert not set(pair) & set(held)
    everything = opened.evaluate_contacts(z, reach=3.0)
    with_door = {
        int(row)
        for row, pair in zip(everything.waypoint, everything.pair, strict=True)
        if set(pair) & set(held)
    }
    assert with_door == set(range(begin, end))


def test_repr(opened: TrajectoryProblem) -> None:
    text = repr(opened)
    for part in (
        "reach door.handle → turn door.knob → move door.hinge, door.knob → go to",
        f"{opened.segments} steps in {0.25 * opened.segments:g} s",
        f"{opened.segments * (opened.chain.size + opened.options.contact_slots + 1)} variables",
        f"{opened.transcription.rows} rows",
        f"{sum(len(part.pairs) for part in opened.contacts.phases)} collision pairs",
    ):
        assert part in text


def test_units(two_grasps: TrajectoryProblem) -> None:
    rail = program_of(full_scene(), [Grasp("cabinet", "rail")], options=SHORT)
    lengths = {"base_x", "base_y", "drawer.slide", "cabinet.slide"}
    assert {name for name in two_grasps.chain.names if two_grasps.unit(name) == "m"} == lengths
    assert rail.unit("cabinet.rail") == "m"
    assert all(two_grasps.unit(name) in ("m", "rad") for name in two_grasps.chain.names)


def test_options_have_defaults() -> None:
    assert program_of(door_scene(), [Reach(POSE)]).options == Options()


def test_scene_steps_and_options_are_not_modified() -> None:
    scene, steps = door_scene(), [Actuate("door", {"hinge": 1.2})]
    start, state, pairs = (
        scene.start.copy(),
        scene.objects["door"].state.copy(),
        len(scene.robot.collision.collisionPairs),
    )
    program_of(scene, steps, options=SHORT)
    np.testing.assert_array_equal(scene.start, start)
    np.testing.assert_array_equal(scene.objects["door"].state, state)
    assert len(scene.robot.collision.collisionPairs) == pairs
    assert steps == [Actuate("door", {"hinge": 1.2})]


@pytest.mark.parametrize(
    ("steps", "error", "match"),
    [
        ([], InputError, "nothing to do"),
        ([Actuate("dor", {"hinge": 1.0})], UnknownNameError, r"dor.*door"),
        ([Actuate("door", {"hing": 1.0})], UnknownNameError, r"hing.*hinge"),
        ([Grasp("door", "handel")], UnknownNameError, r"handel.*handle"),
        (
            [Grasp("door", "handle"), Grasp("door", "handle_free")],
            InputError,
            "two grasps of one joint",
        ),
        ([Reach(POSE, frame="tol")], UnknownNameError, r"tol.*tool"),
        (["open the door"], InputError, "not a step"),
    ],
)
def test_impossible_steps_are_rejected(
    steps: list[Step], error: type[Exception], match: str
) -> None:
    with pytest.raises(error, match=match):
        program_of(door_scene(), steps, options=SHORT)


@pytest.mark.parametrize("waypoints", [1, 3, 10])
def test_a_grasp_is_chosen_within_its_own_phase(waypoints: int) -> None:
    """What an earlier grasp chose does not bind a later one, however short the phases are."""
    scene, few = load_scene("init_1"), Options(reach_waypoints=waypoints)
    aside = Place("stick", pin.SE3(np.eye(3), np.array([2.5, 0.5, 0.771])))
    problem = program_of(scene, [aside, Grasp("stick")], options=few)
    clamped = problem.transcription.structure.clamped
    spans = sorted({(first, last) for _, first, last in clamped})
    assert len(spans) == 2
    assert spans[0][1] < spans[1][0]
    assert all(
        name.startswith("approach") == (waypoints > 1)
        for name in names_of(problem)
        if "approach" in name
    )
