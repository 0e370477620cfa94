"""Compares rows of user-defined terms with numeric Pinocchio and finite differences."""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import room, stand, table
from helpers.relaxed import check_relaxation, iterates
from helpers.small_problems import full_scene, program_of, random_configurations

import vkc_pin as vkc
from vkc_pin.planning.chain.pose import POSE_OFFSET_SIZE
from vkc_pin.planning.nlp.term_rows import TermProgram
from vkc_pin.world.task.phases import Phase
from vkc_pin.world.task.terms import Constraint, Cost

OPTIONS = vkc.Options(reach_waypoints=3, turn_waypoints=2, move_waypoints=3, contact_slots=2)
QUIET = {"ipopt.print_level": 0, "ipopt.sb": "yes"}
PENALTY = 130.0
POINT = np.array([0.4, -0.3, 0.8])


def terms_of(name: str) -> list[Constraint | Cost]:
    if name == "stick":
        return [
            vkc.Constraint("tip", lambda s: s.position("stick.tip"), lower=[-1, -2, 0], upper=3.0),
            vkc.Constraint(
                "tilt", lambda s: s.rotation("stick.stick")[2, 2], lower=0.9, during="place stick"
            ),
            vkc.Constraint(
                "speed",
                lambda s: ca.norm_2(s.velocity("stick.tip")) - ca.sumsqr(s.position("tool")),
                upper=0.0,
            ),
            vkc.Constraint(
                "near",
                lambda s: ca.sumsqr(s.position("forearm_link") - s.position("stick.tip")),
                upper=9.0,
            ),
            vkc.Constraint(
                "elbow", lambda s: s.rate("elbow_joint"), lower=-1.0, upper=1.0, holding="stick"
            ),
            vkc.Cost(
                "waves",
                lambda s: ca.sin(3 * s.coordinate("wrist_1_joint")) * s.position("tool")[2],
                weight=0.7,
            ),
            vkc.Cost(
                "way",
                lambda s: ca.sumsqr(s.velocity("tool")),
                weight=2.0,
                during=["go to", "touch with stick.tip"],
            ),
        ]
    if name == "ball":
        return [
            vkc.Constraint(
                "between", lambda s: ca.norm_2(s.position("ball.ball") - POINT), lower=0.1
            ),
            vkc.Constraint("ball", lambda s: s.velocity("ball.ball"), upper=1.0),
        ]
    assert name == "furniture"
    return [
        vkc.Constraint("panel", lambda s: s.velocity("door.panel"), lower=-1.0, upper=1.0),
        vkc.Constraint(
            "look",
            lambda s: ca.dot(
                s.rotation("tool")[:, 2], s.position("door.panel") - s.position("tool")
            ),
            lower=0.0,
        ),
        vkc.Constraint(
            "tray",
            lambda s: s.rotation("cabinet.knob")[:, 0] * s.coordinate("cabinet.swing"),
            upper=1.0,
        ),
        vkc.Constraint(
            "hinge", lambda s: s.rate("door.hinge") + s.coordinate("cabinet.lid_hinge"), upper=1.0
        ),
        vkc.Constraint("lid", lambda s: s.coordinate("cabinet.lid_hinge"), upper=1.0),
        vkc.Cost("slide", lambda s: s.coordinate("drawer.slide") ** 2 + s.coordinate("base_yaw")),
    ]


@cache
def problem(name: str) -> vkc.TrajectoryProblem:
    if name == "stick":
        scene = room(table())
        steps = [
            vkc.Touch("stick.tip", (0.8, 0.9, 0.7)),
            vkc.Place("stick", (0.8, 0.5, 0.56)),
            vkc.GoTo(0.0, 0.0),
        ]
    elif name == "ball":
        scene = room(stand(), objects=("stick", "ball")).with_held(
            {"stick": "grip"}, at={"stick": (0.02, -0.1)}
        )
        steps = [
            vkc.Grasp("ball", "pull", "stick.tip"),
            vkc.Place("ball", (0.8, 0.6, 0.7)),
            vkc.GoTo(0.0, 0.0),
        ]
    else:
        scene = full_scene()
        steps = [
            vkc.Actuate("cabinet", {"swing": 0.5}),
            vkc.Actuate("door", {"hinge": 1.2}),
            vkc.GoTo(0.0, 0.0),
        ]
    return program_of(scene, steps, options=OPTIONS, terms=terms_of(name))


NAMES = ["stick", "ball", "furniture"]


def random_path(p: vkc.TrajectoryProblem, seed: int = 0) -> np.ndarray:
    """Return z_0..z_N; the objects' joints stand at all values that they have room for."""
    rng = np.random.default_rng(seed)
    return p.waypoints(random_configurations(p.chain.lower, p.chain.upper, p.segments, rng))


def times(p: vkc.TrajectoryProblem) -> np.ndarray:
    return np.random.default_rng(5).uniform(0.1, 0.4, p.segments)


class Numbers:
    """Numeric State: frames of the plain models, and grasps by their definition."""

    def __init__(
        self, p: vkc.TrajectoryProblem, path: np.ndarray, waypoint: int, dt: float
    ) -> None:
        self.p, self.path, self.t, self.dt = p, path, waypoint, dt
        self.ends = [0, *p.ends.tolist()]

    def phase(self, t: int) -> Phase:
        return self.p.task.phases[max(int(np.searchsorted(self.ends, t)) - 1, 0)]

    def _value(self, name: str, t: int) -> float:
        chain = self.p.chain
        if name in chain.names:
            return float(self.path[t, chain.index(name)])
        owner, _, joint = name.partition(".")
        placed = self.p.scene.objects[owner]
        return float(placed.state[placed.object.coordinates.index(joint)])

    def _robot(self, frame: str, t: int) -> pin.SE3:
        robot = self.p.scene.robot
        data = robot.model.createData()
        pin.forwardKinematics(
            robot.model, data, robot.coordinates.q(self.path[t, : robot.coordinates.size])
        )
        return pin.updateFramePlacement(robot.model, data, robot.model.getFrameId(frame)).copy()

    def _held(self, owner: str, t: int, hold: Any) -> pin.SE3:
        """Return the placement of a held base link: holder · (link · A · J(v) · D)⁻¹."""
        placed = self.p.scene.objects[owner]
        attachment = placed.object.attachments[hold.attachment]
        values = [self._value(f"{owner}.{name}", t) for name in attachment.coordinates]
        grasped = placed.object.link_placement(attachment.link, placed.state) * attachment.tool(
            np.array(values)
        )
        if hold.by is None:
            holder = self._robot(self.p.scene.robot.tool_frame, t)
        else:
            carrier = self.p.scene.objects[hold.by.object]
            holder = self._held(hold.by.object, t, hold.by) * carrier.object.link_placement(
                hold.link, carrier.state
            )
        return holder * grasped.inverse()

    def at(self, frame: str, t: int, phase: Phase) -> pin.SE3:
        owner, dot, link = frame.partition(".")
        if not dot:
            return self._robot(frame, t)
        placed = self.p.scene.objects[owner]
        if not placed.object.free:
            state = [self._value(f"{owner}.{name}", t) for name in placed.object.coordinates.names]
            return placed.placement * placed.object.link_placement(link, state)
        hold = next((h for h in phase.held if h.object == owner), None)
        if hold is None and owner in phase.released_by:
            hold, last = phase.released_by[owner]
            t = self.ends[last + 1]
        where = self._held(owner, t, hold) if hold else phase.resting[owner]
        return where * placed.object.link_placement(link, placed.state)

    def position(self, frame: str) -> ca.DM:
        return ca.DM(self.at(frame, self.t, self.phase(self.t)).translation)

    def rotation(self, frame: str) -> ca.DM:
        return ca.DM(self.at(frame, self.t, self.phase(self.t)).rotation)

    def velocity(self, frame: str) -> ca.DM:
        before = self.at(frame, self.t - 1, self.phase(self.t - 1)).translation
        return (self.position(frame) - before) / self.dt

    def coordinate(self, name: str) -> float:
        return self._value(name, self.t)

    def rate(self, name: str) -> float:
        return (self._value(name, self.t) - self._value(name, self.t - 1)) / self.dt


def expected_values(
    p: vkc.TrajectoryProblem, term: Constraint | Cost, path: np.ndarray, dt: np.ndarray
) -> dict[int, np.ndarray]:
    """Return the term's value at every waypoint of its phases after their first."""
    found = {}
    for phase, first, last in zip(p.task.phases, [0, *p.ends[:-1]], p.ends, strict=True):
        if term.is_active(phase.name, [hold.object for hold in phase.held]):
            for t in range(first + 1, last + 1):
                found[int(t)] = np.asarray(
                    ca.DM(term.expression(Numbers(p, path, int(t), dt[t - 1])))
                ).ravel()  # type: ignore[operator, arg-type]
    return found


@pytest.mark.parametrize("name", NAMES)
def test_rows_and_costs_are_the_expressions_at_the_waypoints(name: str) -> None:
    p = problem(name)
    path, dt, t = random_path(p), times(p), p.transcription
    x = t.pack(path[1:], 0.3, 0.4)
    values, _, cost, _ = t.term_values(x, p.start, dt)
    values, first, total, seen = np.asarray(values).ravel(), t.rows - values.numel(), 0.0, 0
    by_name = {term.name: at for term, at in zip(p.terms, t.term_rows, strict=True)}
    for term in terms_of(name):
        expected = expected_values(p, term, path, dt)
        if isinstance(term, Cost):
            total += term.weight * sum(float(value[0]) for value in expected.values())
            assert by_name[term.name] == {}
        else:
            for waypoint, rows in by_name.get(term.name, {}).items():
                # What stands has the speed 1e-4: the root of zero is rounded off.
                atol = 1.01e-4 if term.name == "speed" else 1e-7
                np.testing.assert_allclose(values[rows - first], expected[waypoint], atol=atol)
                seen += len(rows)
    assert seen == len(values) == len(p.term_evaluator.rows)
    assert float(cost) == pytest.approx(total, rel=1e-6)
    assert {name: len(at) for name, at in by_name.items()} == {
        # Where the tip still stands there is nothing to be done about it.
        "stick": {"tip": 9, "tilt": 3, "speed": 12, "near": 12, "elbow": 6, "waves": 0, "way": 0},
        "ball": {"between": 6, "ball": 6},
        "furniture": {"panel": 17, "look": 17, "tray": 17, "hinge": 17, "slide": 0},
    }[name]


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_are_those_of_finite_differences(name: str) -> None:
    p = problem(name)
    t, rng = p.transcription, np.random.default_rng(1)
    solver = t.solver(rates=False, options=QUIET).function
    objective, constraints, lagrangian = (
        solver.get_function(f) for f in ("nlp_grad_f", "nlp_jac_g", "nlp_hess_l")
    )
    planes = rng.normal(size=(t.segments, t.slots, 12 * (p.chain.model.njoints - 1)))
    offsets = rng.normal(size=(t.segments, t.slots))
    pose_offsets = rng.normal(size=(t.segments, len(p.pose_goals), POSE_OFFSET_SIZE))
    excess, relaxation_weights = (
        rng.normal(size=t.rows - t.first_relaxed_row),
        rng.uniform(0.0, 50.0, t.segments),
    )
    taken = {
        "pose_offsets": pose_offsets,
        "excess": excess,
        "relaxation_weights": relaxation_weights,
        "weights": p.motion_cost.weights(*p.rates(random_path(p, 2)[1:])),
    }
    parameters = t.parameter_vector(
        p.start, planes, offsets, p.target_matrix(), penalty=PENALTY, dt=times(p), **taken
    )
    slack, shares = rng.uniform(size=(t.segments, t.slots)), rng.uniform(0.05, 0.95, t.segments)
    x = t.pack(random_path(p, 2)[1:], slack, shares)
    own, step, weight = p.term_evaluator.rows, 1e-5, 0.7
    multipliers = np.zeros(t.rows)
    multipliers[own] = rng.normal(size=len(own))

    def both(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        f, gradient = objective(x, parameters)
        g, jacobian = constraints(x, parameters)
        slope = weight * np.asarray(gradient).ravel() + np.asarray(jacobian.full()).T @ multipliers
        return (
            np.r_[float(f), np.asarray(g).ravel()[own]],
            slope,
            np.vstack([np.asarray(gradient).T, jacobian.full()[own]]),
        )

    sides = [(both(x + step * e), both(x - step * e)) for e in np.eye(len(x))]
    slopes = np.array([(a[0] - b[0]) / (2 * step) for a, b in sides]).T
    np.testing.assert_allclose(both(x)[2], slopes, rtol=1e-6, atol=1e-4)
    half = np.asarray(lagrangian(x, parameters, weight, multipliers).full())
    assert not np.tril(half, -1).any()
    curvature = np.array([(a[1] - b[1]) / (2 * step) for a, b in sides]).T
    np.testing.assert_allclose(half + np.triu(half, 1).T, curvature, rtol=1e-5, atol=1e-3)
    f, z = objective(x, parameters)[0], random_path(p, 2)[1:]
    given = p.rates(z)
    squares = sum(np.sum(w * part**2) for w, part in zip(taken["weights"], given, strict=True))
    assert p.objective(z, times(p)) == pytest.approx(
        p.motion_cost.value(*given) + p.term_evaluator.compute_cost(z, times(p))
    )
    assert squares + p.term_evaluator.compute_cost(z, times(p)) == pytest.approx(
        float(f) - PENALTY * slack.sum() - relaxation_weights @ shares, rel=1e-9
    )
    # A relaxation variable removes the excess of what its waypoint is asked for.
    owner = np.zeros(t.rows, int)
    for at in t.term_rows:
        for waypoint, rows in at.items():
            owner[rows] = waypoint - 1
    values = np.asarray(t.term_values(x, p.start, times(p))[0]).ravel()
    expected = values - shares[owner[own]] * excess[own - t.first_relaxed_row]
    np.testing.assert_allclose(
        np.asarray(constraints(x, parameters)[0]).ravel()[own], expected, rtol=0.0, atol=1e-9
    )


@pytest.mark.parametrize("name", NAMES)
def test_with_shares_of_one_own_constraints_hold_wherever_it_is_set_up(name: str) -> None:
    p = problem(name)
    missing = [check_relaxation(p, z) for z in iterates(p)]
    assert max(each["terms"] for each in missing) > 0.1
    assert max(each["poses"] for each in missing) > 0.1


def test_a_hand_left_where_it_was_counts_after_it_was_let_go_of() -> None:
    """Where the stick ends up depends on the waypoint of the release, and so do rows after it."""
    p = problem("stick")
    t, release = p.transcription, int(p.ends[2])
    at = next(at for term, at in zip(p.terms, t.term_rows, strict=True) if term.name == "near")
    _, jacobian, _, _ = t.term_values(np.full(t.size, 0.1), p.start, times(p))
    first = t.rows - jacobian.shape[0]
    pattern = np.asarray(ca.DM(jacobian.sparsity(), 1.0).full())
    for waypoint, rows in at.items():
        touched = {int(c) // t.width + 1 for c in np.flatnonzero(pattern[rows - first].any(axis=0))}
        assert touched == ({waypoint, release} if waypoint > release else {waypoint}), waypoint


def test_different_terms_give_different_programs() -> None:
    def made(limit: float, upper: float, *, terms: bool = True) -> vkc.TrajectoryProblem:
        near = vkc.Constraint("near", lambda s: s.position("tool")[2] - limit, upper=upper)
        return program_of(
            room(table()), [vkc.GoTo(0.5, 0.5)], options=OPTIONS, terms=[near] if terms else []
        )

    first = made(0.5, 1.0)
    assert made(0.5, 1.0).transcription is first.transcription
    assert made(0.5, 2.0).transcription is first.transcription  # bounds are none of the program's
    assert made(0.6, 1.0).transcription is not first.transcription
    without = made(0.5, 1.0, terms=False)
    assert without.transcription is not first.transcription
    assert not hasattr(without.transcription, "term_values")
    assert first.transcription.rows == without.transcription.rows + OPTIONS.reach_waypoints
    assert first.term_evaluator.upper.tolist() == [1.0] * OPTIONS.reach_waypoints
    parameters = [p.transcription.parameters.numel() for p in (first, without)]
    assert (
        parameters[0] == parameters[1] + OPTIONS.reach_waypoints
    )  # an excess each, but no term needs the time of a step
    fast = vkc.Cost("fast", lambda s: ca.sumsqr(s.velocity("tool")))
    timed = program_of(room(table()), [vkc.GoTo(0.5, 0.5)], options=OPTIONS, terms=[fast])
    assert (
        timed.transcription.parameters.numel() == parameters[1] + OPTIONS.reach_waypoints
    )  # a cost has no excess


def test_errors_count_in_tolerances() -> None:
    low = vkc.Constraint("low", lambda s: s.coordinate("base_x"), upper=0.5, tolerance=0.02)
    p = program_of(room(table()), [vkc.GoTo(1.0, 0.0)], options=OPTIONS, terms=[low])
    z = p.still
    dt = p.timing_for(z).dt
    assert p.term_evaluator.compute_violation(z, dt) == p.row_error(z, dt) - p.pose_error(z) == 0.0
    z[1, 0] = 0.54  # twice the tolerance
    assert p.term_evaluator.compute_violation(z, dt) == pytest.approx(2e-3)
    assert p.row_error(z, dt) == pytest.approx(2e-3)
    assert p.pose_error(z) == 0.0
    z[1, 0] = np.nan
    assert p.term_evaluator.compute_violation(z, dt) == np.inf


def test_steps_take_longer_where_a_speed_asks_for_it() -> None:
    def at(limit: float, start: float = 0.0) -> vkc.TrajectoryProblem:
        slow = vkc.Constraint(
            "slow",
            lambda s: ca.norm_2(s.velocity("tool")),
            lower=start,
            upper=limit,
            tolerance=1e-3,
        )
        return program_of(
            room(), [vkc.GoTo(2.0, 0.0)], options=vkc.Options(reach_waypoints=20), terms=[slow]
        )

    share = np.linspace(0.0, 1.0, 21)[1:, None]
    usual = at(9.0)
    z = usual.start + share**2 * (3 - 2 * share) * np.r_[2.0, np.zeros(8)]
    dt = usual.timing_for(z).dt
    fastest = np.abs(np.diff(usual.waypoints(z)[:, 0])).max() / dt[0]
    limited = at(fastest / 2)
    slower = limited.timing_for(z)
    assert limited.term_evaluator.compute_violation(z, slower.dt) <= 1e-3
    assert 2.0 - 1e-2 <= slower.dt[0] / dt[0] <= 2.0 * 1.2
    np.testing.assert_allclose(slower.velocity, limited.chain.velocity * slower.dt[:, None])
    hopeless = at(fastest / 2, start=fastest / 3)  # at rest, too
    assert hopeless.timing_for(z).dt[0] <= 8.0 * dt[0]


def test_terms_without_a_derivative_are_rejected() -> None:
    for expression in (
        lambda s: ca.acos(s.rotation("stick.stick")[2, 2]),
        lambda s: 1 / ca.sumsqr(s.velocity("tool")),
    ):
        for term in (vkc.Constraint("mine", expression, upper=0.2), vkc.Cost("mine", expression)):
            with pytest.raises(
                vkc.InputError,
                match=r"terms\['mine'\]\.expression: "
                "its value or derivative is not finite at the start",
            ):
                program_of(
                    room(table()).with_held({"stick": "grip"}),
                    [vkc.GoTo(0.5, 0.5)],
                    options=OPTIONS,
                    terms=[term],
                )


def test_constant_terms_have_no_rows() -> None:
    here = vkc.Constraint("here", lambda s: s.position("stick.tip"), upper=-9.0, during="go to")
    p = program_of(room(table()), [vkc.GoTo(1.0, 0.0)], options=OPTIONS, terms=[here])
    assert p.terms == ()
    assert p.transcription.structure.terms == ()


def test_an_empty_program() -> None:
    p = problem("furniture")
    for width in (None, p.chain.size + 5):
        part = TermProgram(
            p.chain.model,
            (),
            ca.MX.sym("z", p.chain.size, 4),
            ca.MX.sym("dt", 3),
            p.cache,
            width=width,
        )
        assert part.rows == 0
        assert part.jacobian.shape == (0, 3 * (width or p.chain.size))
