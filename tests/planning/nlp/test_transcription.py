"""Compares the nonlinear program with its definitions, and its derivatives with differences."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from functools import cache

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import room, stand, table
from helpers.relaxed import Relaxed, check_relaxation, iterates
from helpers.small_problems import CACHE, door_scene, full_scene, program_of, random_configurations

from vkc_pin.options import Options
from vkc_pin.planning.nlp.inspection import patterns
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.nlp.transcription import transcribe
from vkc_pin.planning.nlp.waypoint import get_waypoint_functions
from vkc_pin.utils.cache import Cache
from vkc_pin.world.models.robot_file import load_robot
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Actuate, GoTo, Grasp, Place, Reach, Release, Step, Touch

OPTIONS = Options(reach_waypoints=3, turn_waypoints=2, move_waypoints=3, contact_slots=2)
QUIET = {"ipopt.print_level": 0, "ipopt.sb": "yes"}
PENALTY = 7.0


@cache
def differential_scene() -> Scene:
    return dataclasses.replace(door_scene(), robot=load_robot("husky_ur5e", base="differential"))


@cache
def car_scene() -> Scene:
    return dataclasses.replace(
        door_scene(), robot=load_robot("husky_ur5e", base="ackermann", turning_radius=0.8)
    )


@cache
def problem(name: str) -> TrajectoryProblem:
    pose = pin.SE3(pin.rpy.rpyToMatrix(0.3, -2.0, 0.7), np.array([0.4, 0.2, 0.9]))
    if name == "reach":
        return program_of(door_scene(), [Reach(pose)], options=OPTIONS)
    if name == "door":
        return program_of(door_scene(), [Actuate("door", {"hinge": 1.2})], options=OPTIONS)
    if name in ("differential", "ackermann"):
        scene = differential_scene() if name == "differential" else car_scene()
        return program_of(scene, [Reach(pose), GoTo(0.0, 0.0, 1.0)], options=OPTIONS)
    if (
        name == "stick"
    ):  # chosen where to grasp, clamped from then on; a point, and an upright place
        return program_of(
            room(table()),
            [Touch("stick.tip", (0.8, 0.9, 0.7)), Place("stick", (0.8, 0.5, 0.56))],
            options=OPTIONS,
        )
    if (
        name == "fetch"
    ):  # a ball with the stick that is held at the start, then the stick itself is put away
        scene = room(stand(), objects=("stick", "ball")).with_held(
            {"stick": "grip"}, at={"stick": (0.02, -0.1)}
        )
        steps = [
            Grasp("ball", "pull", "stick.tip"),
            Place("ball", pose),
            Release("stick"),
            GoTo(0.0, 0.0),
        ]
        return program_of(scene, steps, options=OPTIONS)
    if name == "push":  # from the start on, and then at another face
        scene = door_scene().with_state("door", {"hinge": -1.0}).with_held({"door": "push"})
        return program_of(
            scene, [Actuate("door", {"hinge": -0.5}), GoTo(0.0, 0.0)], options=OPTIONS
        )
    assert name == "two grasps"  # the second ends nothing: there is a pose to reach after it
    steps = [
        Grasp("cabinet", "ball"),
        Actuate("drawer", {"slide": 0.2}, attachment="handle_free"),
        Reach(pose),
    ]
    return program_of(full_scene(), steps, options=OPTIONS)


NAMES = ["reach", "door", "differential", "ackermann", "two grasps", "stick", "fetch", "push"]


@dataclass
class Point:
    """Where the program is evaluated: everything random but the targets."""

    problem: TrajectoryProblem
    z: np.ndarray  # (N, n)
    slack: np.ndarray  # (N, K)
    shares: np.ndarray  # (N,)
    planes: np.ndarray  # (N, K, 12·joints)
    offsets: np.ndarray  # (N, K)
    pose_offsets: np.ndarray  # (N, poses, 7)
    excess: np.ndarray  # (rows after those of poses,)
    rate_excess: np.ndarray  # (rows of rates,)
    relaxation_weights: np.ndarray  # (N,)
    weights: tuple[np.ndarray, np.ndarray]  # of squared steps (N, n), and of their squared changes
    dt: np.ndarray  # (N,)
    gears: np.ndarray  # (N,)

    @property
    def x(self) -> np.ndarray:
        return np.column_stack([self.z, self.slack, self.shares]).ravel()

    @property
    def penalties(self) -> float:
        """What slacks and shares cost."""
        return float(PENALTY * self.slack.sum() + self.relaxation_weights @ self.shares)

    def parameters(self, *, rates: bool = False) -> np.ndarray:
        p = self.problem
        vector = p.transcription.parameter_vector(
            p.start,
            self.planes,
            self.offsets,
            p.target_matrix(),
            weights=self.weights,
            penalty=PENALTY,
            dt=self.dt,
            pose_offsets=self.pose_offsets,
            excess=self.excess,
            relaxation_weights=self.relaxation_weights,
            gears=self.gears,
        )
        return np.concatenate([vector, self.rate_excess]) if rates else vector

    def relax_target(self, waypoint: int, number: int) -> pin.SE3:
        """Return where the target of a pose has gone at a waypoint, by Pinocchio."""
        target, pose_offsets, share = (
            self.problem.targets[number],
            self.pose_offsets[waypoint - 1, number],
            self.shares[waypoint - 1],
        )
        turn = pin.exp3(share * pose_offsets[6] * pose_offsets[3:6])
        return pin.SE3(target.rotation @ turn, target.translation + share * pose_offsets[:3])

    def at_shares(self, shares: float) -> Point:
        """Return the same point with all shares the same."""
        return dataclasses.replace(self, shares=np.full(self.problem.segments, shares))


def random_point(p: TrajectoryProblem, seed: int = 0) -> Point:
    """Return a point with relaxation variables between 0 and 1, and random excess."""
    rng, t = np.random.default_rng(seed), p.transcription
    N, K = t.segments, t.slots
    axes = rng.normal(size=(N, len(p.pose_goals), 3))
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    turns = rng.uniform(0.0, np.pi, (N, len(p.pose_goals), 1))
    return Point(
        problem=p,
        z=random_configurations(p.chain.lower, p.chain.upper, N, rng),
        slack=rng.uniform(0.0, 1.0, (N, K)),
        shares=rng.uniform(0.05, 0.95, N),
        planes=rng.normal(size=(N, K, 12 * (p.chain.model.njoints - 1))),
        offsets=rng.normal(size=(N, K)),
        pose_offsets=np.concatenate([rng.normal(size=axes.shape), axes, turns], axis=2),
        excess=rng.normal(size=t.rows - t.first_relaxed_row),
        rate_excess=rng.normal(size=t.rate_matrix.size1()),
        relaxation_weights=rng.uniform(0.0, 50.0, N),
        weights=tuple(rng.uniform(0.1, 3.0, part.shape) for part in p.rates(p.still)),
        dt=rng.uniform(0.1, 0.4, N),
        gears=np.where(np.arange(N) % 2, 1.0, -1.0),
    )


def functions(p: TrajectoryProblem, *, rates: bool) -> tuple[ca.Function, ca.Function, ca.Function]:
    """Return Ipopt's functions: x, p → f, ∇f; x, p → g, ∂g; x, p, σ, λ → triu ∇²L."""
    solver = p.transcription.solver(rates=rates, options=QUIET).function
    return tuple(solver.get_function(name) for name in ("nlp_grad_f", "nlp_jac_g", "nlp_hess_l"))


def rows(point: Point, *, rates: bool = False) -> np.ndarray:
    value, _ = functions(point.problem, rates=rates)[1](point.x, point.parameters(rates=rates))
    return np.asarray(value).ravel()


def relaxed_excess(point: Point, waypoints: list[int], excess: np.ndarray) -> np.ndarray:
    """Return the share of the excess of rows, given the waypoint that each row belongs to."""
    assert len(waypoints) == len(excess)
    return np.asarray(point.shares[np.array(waypoints, int) - 1] * excess)


def excess_at(point: Point, which: np.ndarray) -> np.ndarray:
    """Return the excess of these rows."""
    return np.asarray(point.excess[which - point.problem.transcription.first_relaxed_row])


def differences(function, x: np.ndarray, step: float = 1e-5) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Return the central differences of a vector function, shape (rows, len(x))."""
    columns = [
        (function(x + step * e) - function(x - step * e)) / (2 * step) for e in np.eye(len(x))
    ]
    return np.array(columns).T


def clamped(p: TrajectoryProblem) -> list[tuple[int, int, int]]:
    """Return column, first and last waypoint of the freedoms of firm grasps."""
    found = []
    for hold, names in p.chain.virtual.items():
        firm = p.scene.objects[hold.object].object.attachments[hold.attachment].firm
        grasps = [k for k, phase in enumerate(p.task.phases) if hold in phase.grasps]
        for k in grasps if firm else ():
            held = itertools.takewhile(
                lambda j, hold=hold: hold in p.task.phases[j].held, range(k + 1, len(p.task.phases))
            )
            last = max([k, *held])
            before = max(1, int(p.ends[k]) - OPTIONS.steps(OPTIONS.approach_time))
            found += [(p.chain.index(name), before, int(p.ends[last])) for name in names]
    return found


def clamp_rows(p: TrajectoryProblem) -> np.ndarray:
    """Return the clamping rows: one for each clamped coordinate and step."""
    count = sum(last - first for _, first, last in clamped(p))
    return p.transcription.rows - len(p.transcription.pushed_rows) - count + np.arange(count)


def stretches(p: TrajectoryProblem) -> list[np.ndarray]:
    """Return the waypoints of each run: from the start, grasps and releases, to the end."""
    neighbours = zip(p.ends[:-1], p.task.phases[:-1], p.task.phases[1:], strict=True)
    hands = [int(end) for end, a, b in neighbours if a.grasps or set(a.held) - set(b.held)]
    stops = [0, *hands, p.segments]
    return [np.arange(a, b + 1) for a, b in itertools.pairwise(stops)]


# --- definitions
# ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_the_objective_is_of_weighted_squares_of_steps_and_their_changes(name: str) -> None:
    p = problem(name)
    point, change = random_point(p), 0
    path = np.vstack([p.start, point.z])
    expected = point.penalties
    for stretch in stretches(p):
        step = np.diff(path[stretch], axis=0)
        bend = np.diff(np.vstack([np.zeros(p.chain.size), step, np.zeros(p.chain.size)]), axis=0)
        expected += np.sum(point.weights[0][stretch[1:] - 1] * step**2)
        expected += np.sum(point.weights[1][change : change + len(bend)] * bend**2)
        change += len(bend)
    value, _ = functions(p, rates=False)[0](point.x, point.parameters())
    assert change == len(point.weights[1])
    assert float(value) == pytest.approx(expected, rel=1e-10)


def test_there_are_rests_where_a_hand_closes_or_opens() -> None:
    assert [len(stretches(problem(name))) for name in NAMES] == [1, 2, 1, 1, 4, 2, 3, 2]


@pytest.mark.parametrize("name", NAMES)
def test_witness_rows_are_planes_over_the_placements_plus_slack(name: str) -> None:
    p = problem(name)
    point, model = random_point(p), p.chain.model
    g, data = rows(point), model.createData()
    assert p.transcription.slot_rows.shape == (p.segments, OPTIONS.contact_slots)
    for t, q in enumerate(p.chain.coordinates.q(point.z)):
        pin.forwardKinematics(model, data, q)
        stacked = np.concatenate(
            [
                np.r_[data.oMi[j].rotation.T.ravel(), data.oMi[j].translation]
                for j in range(1, model.njoints)
            ]
        )
        expected = (
            point.planes[t] @ stacked - point.offsets[t] + point.slack[t]
        )  # each plane has a slack of its own
        np.testing.assert_allclose(g[p.transcription.slot_rows[t]], expected, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("name", NAMES)
def test_pose_rows_are_residuals_to_the_relaxed_target(name: str) -> None:
    """To where the target has relaxed."""
    p = problem(name)
    point, model = random_point(p), p.chain.model
    g, data, t = rows(point), model.createData(), p.transcription
    assert len(t.pose_rows) == len(t.structure.poses) == len(p.targets) == len(p.pose_goals)
    for number, (pose, at) in enumerate(zip(t.structure.poses, t.pose_rows, strict=True)):
        assert tuple(sorted(at)) == pose.waypoints
        for waypoint, which in at.items():
            target = point.relax_target(waypoint, number)
            pin.forwardKinematics(model, data, p.chain.coordinates.q(point.z[waypoint - 1]))
            placement = data.oMi[pose.joint] * pose.local
            shift = (
                np.zeros(3)
                if pose.shift is None
                else data.oMi[pose.shift[0]].rotation @ np.array(pose.shift[1])
            )
            expected = [placement.translation + shift - target.translation]
            if pose.kind == "pose":
                error = target.rotation.T @ placement.rotation
                turn = pin.log3(error)
                angle = np.linalg.norm(turn)
                expected += [np.sin(angle) * turn / angle, [np.trace(error)]]
            elif pose.kind == "upright":
                expected.append(target.rotation @ placement.rotation.T @ np.array([0.0, 0.0, 1.0]))
            np.testing.assert_allclose(g[which], np.concatenate(expected), rtol=0.0, atol=1e-8)


def test_there_are_goals_of_all_kinds() -> None:
    kinds = {
        name: [pose.kind for pose in problem(name).transcription.structure.poses] for name in NAMES
    }
    assert set(kinds["stick"]) == {"pose", "point", "upright"}
    assert {kind for name in NAMES if name != "stick" for kind in kinds[name]} == {"pose"}
    assert any(pose.shift for pose in problem("fetch").transcription.structure.poses)


@pytest.mark.parametrize("name", NAMES)
def test_clamped_coordinates_keep_their_values(name: str) -> None:
    """There is one row per step from the approach to the end of the hold."""
    p = problem(name)
    point = random_point(p)
    path = p.waypoints(point.z)
    steps = [(column, t) for column, first, last in clamped(p) for t in range(first + 1, last + 1)]
    expected = np.array([path[t, column] - path[t - 1, column] for column, t in steps])
    expected -= relaxed_excess(point, [t for _, t in steps], excess_at(point, clamp_rows(p)))
    np.testing.assert_allclose(rows(point)[clamp_rows(p)], expected, rtol=0.0, atol=1e-12)
    assert p.transcription.structure.clamped == tuple(clamped(p))
    assert len(expected) == {"stick": 2 * 8, "fetch": 3 * 5}.get(name, 0)


def test_pushed_coordinates_move_in_one_direction() -> None:
    """There is one row per step of the phase: the hinge's displacement, at least 0."""
    p = problem("push")
    point, column, t = random_point(p), p.chain.index("door.hinge"), p.transcription
    path, phase = p.waypoints(point.z)[:, column], p.task.phases[0]
    assert (phase.name, phase.pushed) == ("move door.hinge", {"door.hinge": 1})
    expected = np.diff(path)[: phase.segments]
    expected -= relaxed_excess(
        point, list(range(1, phase.segments + 1)), excess_at(point, t.pushed_rows)
    )
    np.testing.assert_allclose(rows(point)[t.pushed_rows], expected, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(
        t.pushed_rows, t.rows - phase.segments + np.arange(phase.segments)
    )
    lower, upper = p.row_bounds(None)
    assert set(lower[t.pushed_rows]) == {0.0}
    assert set(upper[t.pushed_rows]) == {np.inf}
    shut = door_scene().with_state("door", {"hinge": 1.0}).with_held({"door": "push_back"})
    other = program_of(shut, [Actuate("door", {"hinge": 0.5}), GoTo(0.0, 0.0)], options=OPTIONS)
    back, there = other.task.phases[0].pushed, random_point(other)
    assert back == {"door.hinge": -1}
    moved = -np.diff(other.waypoints(there.z)[:, column])[: phase.segments]
    moved -= relaxed_excess(
        there, list(range(1, phase.segments + 1)), excess_at(there, other.transcription.pushed_rows)
    )
    np.testing.assert_allclose(
        rows(there)[other.transcription.pushed_rows], moved, rtol=0.0, atol=1e-12
    )


def test_rows_of_a_base_on_wheels() -> None:
    """Rows are lateral displacement, curvature limit of a car, and wheel travel."""
    for name in ("differential", "ackermann"):
        p = problem(name)
        point = random_point(p)
        path, gears, robot = p.waypoints(point.z), point.gears, p.chain.robot
        assert set(gears) == {-1.0, 1.0}
        step, heading, turn = (
            np.diff(path[:, :2], axis=0),
            (path[1:, 2] + path[:-1, 2]) / 2,
            np.diff(path[:, 2]),
        )
        aside = np.cos(heading) * step[:, 1] - np.sin(heading) * step[:, 0]
        along = np.cos(heading) * step[:, 0] + np.sin(heading) * step[:, 1]
        steered = (
            [gears * along - 0.8 * turn, gears * along + 0.8 * turn] if name == "ackermann" else []
        )
        wheels = [along - robot.wheels.track / 2 * turn, along + robot.wheels.track / 2 * turn]
        expected = np.column_stack([aside, *steered, *wheels])
        owners = np.repeat(np.arange(1, p.segments + 1), expected.shape[1]).tolist()
        expected = expected.ravel() - relaxed_excess(
            point, owners, excess_at(point, p.transcription.base_rows)
        )
        np.testing.assert_allclose(
            rows(point)[p.transcription.base_rows], expected, rtol=0.0, atol=1e-12
        )
        lower, upper = (
            bound[p.transcription.base_rows].reshape(p.segments, -1)
            for bound in p.row_bounds(p.timing_for(p.still))
        )
        assert not lower[:, 0].any()
        assert not upper[:, 0].any()
        np.testing.assert_allclose(upper[:, -2:], 1.0 * OPTIONS.dt, rtol=1e-4)
        np.testing.assert_array_equal(lower[:, -2:], -upper[:, -2:])
        np.testing.assert_array_equal(lower[:, 1:-2], 0.0)
        assert np.isinf(upper[:, 1:-2]).all()
        assert np.isinf(
            p.row_bounds(None)[1][p.transcription.base_rows].reshape(p.segments, -1)[:, -2:]
        ).all()
    for name in set(NAMES) - {"differential", "ackermann"}:
        assert problem(name).transcription.base_rows.size == 0


@pytest.mark.parametrize("name", NAMES)
def test_rate_rows_are_steps_and_their_changes(name: str) -> None:
    p = problem(name)
    point, t = random_point(p), p.transcription
    g = rows(point, rates=True)
    np.testing.assert_array_equal(g[: t.rows], rows(point))
    path = p.waypoints(point.z)
    steps = np.diff(path, axis=0)
    changes = [
        np.diff(np.vstack([np.zeros(t.n), np.diff(path[stretch], axis=0), np.zeros(t.n)]), axis=0)
        for stretch in stretches(p)
    ]
    expected = np.concatenate([steps.ravel(), *(change.ravel() for change in changes)])
    # A step belongs to the waypoint that it leads to, a change to the one at which it happens, at
    # the start to the first after.
    owners = [
        *range(1, p.segments + 1),
        *(max(int(t), 1) for stretch in stretches(p) for t in stretch),
    ]
    raw = point.at_shares(0.0)
    np.testing.assert_allclose(rows(raw, rates=True)[t.rows :], expected, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(t.rate_waypoints, np.repeat(np.array(owners) - 1, t.n))
    expected = expected - relaxed_excess(point, np.repeat(owners, t.n).tolist(), point.rate_excess)
    np.testing.assert_allclose(g[t.rows :], expected, rtol=0.0, atol=1e-12)
    assert len(expected) == p.chain.size * (p.segments + p.segments + len(changes))


@pytest.mark.parametrize("name", NAMES)
def test_every_row_has_one_meaning(name: str) -> None:
    t = problem(name).transcription
    parts = [
        t.slot_rows.ravel(),
        t.base_rows,
        *(which for at in t.pose_rows for which in at.values()),
    ]
    parts += [clamp_rows(problem(name)), t.pushed_rows]
    np.testing.assert_array_equal(np.sort(np.concatenate(parts)), np.arange(t.rows))
    assert t.width == t.n + t.slots + 1
    assert t.size == t.segments * t.width
    firm = np.concatenate(
        [t.slot_rows.ravel(), *(which for at in t.pose_rows for which in at.values())]
    )
    np.testing.assert_array_equal(np.sort(firm), np.arange(t.first_relaxed_row))
    assert len(t.row_waypoints) == t.rows - t.first_relaxed_row


# --- derivatives
# ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_gradient_and_jacobian_are_those_of_finite_differences(name: str) -> None:
    """A true nonzero that the sparsity pattern lacks would show up as a difference, too."""
    p = problem(name)
    point = random_point(p, seed=1)
    objective, constraints, _ = functions(p, rates=True)
    parameters = point.parameters(rates=True)
    _, gradient = objective(point.x, parameters)
    expected = differences(lambda x: np.asarray(objective(x, parameters)[0]).ravel(), point.x)
    np.testing.assert_allclose(np.asarray(gradient).ravel(), expected[0], rtol=1e-6, atol=1e-5)
    _, jacobian = constraints(point.x, parameters)
    expected = differences(lambda x: np.asarray(constraints(x, parameters)[0]).ravel(), point.x)
    np.testing.assert_allclose(np.asarray(jacobian.full()), expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("rates", [False, True])
@pytest.mark.parametrize("name", NAMES)
def test_hessian_of_the_lagrangian_is_that_of_finite_differences(name: str, rates: bool) -> None:
    p = problem(name)
    point = random_point(p, seed=2)
    objective, constraints, lagrangian = functions(p, rates=rates)
    multipliers, weight = np.random.default_rng(3).normal(size=len(rows(point, rates=rates))), 0.7
    parameters = point.parameters(rates=rates)

    def slope(x: np.ndarray) -> np.ndarray:
        gradient, jacobian = objective(x, parameters)[1], constraints(x, parameters)[1]
        return weight * np.asarray(gradient).ravel() + np.asarray(jacobian.full()).T @ multipliers

    half = np.asarray(lagrangian(point.x, parameters, weight, multipliers).full())
    assert not np.tril(half, -1).any()
    expected = differences(slope, point.x)
    np.testing.assert_allclose(half + np.triu(half, 1).T, expected, rtol=1e-5, atol=2e-5)


@pytest.mark.parametrize("name", NAMES)
def test_patterns_hold_everywhere(name: str) -> None:
    """Patterns are found at one point; derivatives at others must fit in them."""
    p = problem(name)
    _, constraints, lagrangian = functions(p, rates=False)
    sizes = set()
    for seed in range(4, 7):
        point = random_point(p, seed=seed)
        parameters = point.parameters()
        jacobian = constraints(point.x, parameters)[1]
        hessian = lagrangian(point.x, parameters, 1.0, np.ones(p.transcription.rows))
        sizes.add((jacobian.nnz(), hessian.nnz()))
        probe = np.random.default_rng(seed).normal(size=p.transcription.size)
        ahead, behind = (
            np.asarray(constraints(point.x + s * 1e-6 * probe, parameters)[0]).ravel()
            for s in (1.0, -1.0)
        )
        np.testing.assert_allclose(
            np.asarray(jacobian @ probe).ravel(), (ahead - behind) / 2e-6, rtol=1e-5, atol=1e-5
        )
    assert len(sizes) == 1
    # Waypoints hang together by rates, and what is clamped, alone: all other rows of one touch no
    # other's variables.
    if p.transcription.base_rows.size == 0:
        row, column = (np.array(part) for part in jacobian.sparsity().get_triplet())
        alone = ~np.isin(row, [*clamp_rows(p), *p.transcription.pushed_rows])
        row, column = row[alone], column[alone]
        owner = np.empty(p.transcription.rows, int)
        owner[p.transcription.slot_rows] = np.arange(p.segments)[:, None]
        for at in p.transcription.pose_rows:
            for waypoint, which in at.items():
                owner[which] = waypoint - 1
        np.testing.assert_array_equal(owner[row], column // p.transcription.width)
    # A slack is for its own plane, and a share for all rows of its waypoint but those of planes.
    t = p.transcription
    pattern, curved = (matrix.toarray() != 0.0 for matrix in patterns(p))
    assert not (np.asarray(jacobian.full()) != 0.0)[~pattern].any()
    for k in range(p.segments):
        columns = k * t.width + np.arange(t.n, t.width)
        np.testing.assert_array_equal(
            np.argwhere(pattern[:, columns[:-1]]),
            np.column_stack([t.slot_rows[k], np.arange(t.slots)]),
        )
        assert not curved[columns[:-1]].any()
        touched = [
            which for at in t.pose_rows for waypoint, which in at.items() if waypoint == k + 1
        ]
        touched.append(t.first_relaxed_row + np.flatnonzero(t.row_waypoints == k))
        np.testing.assert_array_equal(
            np.flatnonzero(pattern[:, columns[-1]]), np.sort(np.concatenate(touched))
        )


# --- relaxation
# ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_wherever_it_is_set_up_it_is_feasible_there_with_shares_of_one(name: str) -> None:
    p, missing = (
        problem(name),
        dict.fromkeys(("poses", "rolling", "clamped", "rates", "clearance"), 0.0),
    )
    for z in iterates(p):
        for kind, amount in check_relaxation(p, z).items():
            missing[kind] = max(missing.get(kind, 0.0), amount)
    there = {kind for kind, amount in missing.items() if amount > 0.1}
    expected = {"poses", "clearance", "rates"}
    expected |= {"rolling"} if name in ("differential", "ackermann") else set()
    expected |= {"clamped"} if name in ("stick", "fetch", "push") else set()
    assert there == expected, "a test in which nothing is missing says nothing"


@pytest.mark.parametrize("off", [0.0, 1e-9, 1e-6, 1e-4, 1e-3, 0.01])
@pytest.mark.parametrize("axis", [*np.eye(3), None], ids=["x", "y", "z", "random"])
def test_relaxed_program_is_feasible_near_half_turns(axis: np.ndarray | None, off: float) -> None:
    """Next to a half turn the rows themselves all but vanish, and the residual has two signs."""
    p, rng = problem("reach"), np.random.default_rng(22)
    for z in iterates(p, 3)[:3]:
        about = rng.normal(size=3) if axis is None else axis
        pose, data = p.transcription.structure.poses[0], p.chain.model.createData()
        pin.forwardKinematics(p.chain.model, data, p.chain.coordinates.q(z[-1]))
        turn = pin.AngleAxis(np.pi - off, about / np.linalg.norm(about)).matrix()
        there = data.oMi[pose.joint] * pose.local * pin.SE3(turn, np.array([0.1, -0.2, 0.3]))
        turned = program_of(door_scene(), [Reach(there)], options=OPTIONS)
        assert turned.transcription is p.transcription
        check_relaxation(turned, z)
        found = Relaxed(turned, z).found
        assert found.amounts["poses"][-1] == pytest.approx(
            np.pi - off + np.linalg.norm([0.1, -0.2, 0.3]), abs=1e-8
        )


def test_satisfied_poses_need_no_relaxation() -> None:
    p = problem("reach")
    z = iterates(p, 1)[0]
    pose, data = p.transcription.structure.poses[0], p.chain.model.createData()
    pin.forwardKinematics(p.chain.model, data, p.chain.coordinates.q(z[-1]))
    there = program_of(door_scene(), [Reach(data.oMi[pose.joint] * pose.local)], options=OPTIONS)
    at = Relaxed(there, z)
    assert at.found.amounts["poses"].max() < 1e-9
    rows = there.transcription.pose_rows[0][there.segments]
    np.testing.assert_allclose(at.rows(1.0)[rows], at.rows(0.0)[rows], rtol=0.0, atol=1e-9)


# --- reuse
# ------------------------------------------------------------------------------------------------


def moved_door(scene: Scene) -> Scene:
    placed = scene.objects["door"]
    shifted = dataclasses.replace(
        placed,
        placement=pin.SE3(pin.utils.rotate("z", 0.4), np.array([0.3, -0.2, 0.0]))
        * placed.placement,
    )
    return dataclasses.replace(scene, objects={**scene.objects, "door": shifted})


def test_one_program_serves_all_problems_of_a_structure() -> None:
    steps, scene = [Actuate("door", {"hinge": 1.2})], door_scene()
    first = program_of(scene, steps, options=OPTIONS)
    spent = CACHE.build_time
    fewer = dataclasses.replace(scene, obstacles=(), obstacle_labels=())
    others = [
        program_of(scene.with_start(base=[-1.0, 0.2, 0.5]), steps, options=OPTIONS),
        program_of(scene.sample_start(np.random.default_rng(0)), steps, options=OPTIONS),
        program_of(moved_door(scene), steps, options=OPTIONS),
        program_of(fewer, steps, options=OPTIONS),
        program_of(scene, [Actuate("door", {"hinge": 0.4})], options=OPTIONS),
        program_of(scene.with_state("door", {"knob": 0.1}), steps, options=OPTIONS),
        program_of(scene, steps, options=dataclasses.replace(OPTIONS, dist_safe=0.05, penalty=3.0)),
    ]
    for other in others:
        assert other.transcription is first.transcription
    assert CACHE.build_time == spent
    again = [
        program_of(scene, [Reach(pin.SE3.Random())], options=OPTIONS).transcription
        for _ in range(2)
    ]
    assert again[0] is again[1]
    assert again[0] is not first.transcription


@pytest.mark.parametrize(
    ("steps", "options"),
    [
        ([Actuate("door", {"hinge": 1.2})], dataclasses.replace(OPTIONS, move_waypoints=4)),
        ([Actuate("door", {"hinge": 1.2})], dataclasses.replace(OPTIONS, contact_slots=3)),
        ([Actuate("door", {"hinge": 1.2}, attachment="handle_free")], OPTIONS),
        ([Actuate("door", {"knob": 0.6})], OPTIONS),
        ([Grasp("door")], OPTIONS),
        ([Actuate("door", {"hinge": 1.2}), GoTo(0.0, 0.0)], OPTIONS),
    ],
)
def test_another_structure_gets_another_program(steps: list[Step], options: Options) -> None:
    structure = program_of(
        door_scene(), [Actuate("door", {"hinge": 1.2})], options=OPTIONS
    ).transcription.structure
    other = program_of(door_scene(), steps, options=options).transcription.structure
    assert other.key != structure.key


def test_a_base_that_cannot_slip_has_another_structure() -> None:
    keys = [
        program_of(scene, [GoTo(0.0, 0.0)], options=OPTIONS).transcription.structure.key
        for scene in (door_scene(), differential_scene())
    ]
    assert keys[0] != keys[1]


def test_functions_of_waypoints_are_shared_by_structures() -> None:
    """However many waypoints there are, and wherever they must satisfy poses."""
    structure, cache = problem("reach").transcription.structure, Cache()
    pose = structure.poses[0]
    first = get_waypoint_functions(structure.model, 3, (pose,), cache)
    assert (
        get_waypoint_functions(
            structure.model, 3, (dataclasses.replace(pose, waypoints=(1, 2)),), cache
        )
        is first
    )
    almost = pin.SE3(pose.local.rotation, pose.local.translation + 1e-14)  # other last digits
    others = [
        get_waypoint_functions(structure.model, 4, (pose,), cache),
        get_waypoint_functions(structure.model, 3, (), cache),
        get_waypoint_functions(structure.model, 3, (pose, pose), cache),
        get_waypoint_functions(
            structure.model, 3, (dataclasses.replace(pose, kind="point"),), cache
        ),
        get_waypoint_functions(
            structure.model, 3, (dataclasses.replace(pose, local=pin.SE3.Random()),), cache
        ),
        get_waypoint_functions(
            structure.model, 3, (dataclasses.replace(pose, local=almost),), cache
        ),
    ]
    assert len({id(one) for one in [first, *others]}) == 7


def test_solvers_are_cached() -> None:
    structure, cache = problem("reach").transcription.structure, Cache()
    t = transcribe(structure, cache)
    assert transcribe(structure, cache) is t
    first, spent = t.solver(rates=False, options=QUIET), cache.build_time
    assert t.solver(rates=False, options=dict(reversed(QUIET.items()))) is first
    assert cache.build_time == spent
    assert t.solver(rates=False, options={**QUIET, "ipopt.tol": 1e-3}) is not first
    assert cache.build_time > spent
