"""Compares rows of user-defined terms with numeric Pinocchio, and derivatives with differences."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import describe_stand, describe_table, make_room
from helpers.held_sticks import make_scene_with_held_stick
from helpers.program_points import make_random_point
from helpers.relaxed import check_relaxation, make_iterates
from helpers.small_problems import make_full_scene, make_program

import vkc_pin as vkc
from vkc_pin.world.task.terms import Constraint, Cost

OPTIONS = vkc.Options(reach_waypoints=3, turn_waypoints=2, move_waypoints=3, contact_slots=2)
POINT = np.array([0.4, -0.3, 0.8])


def make_terms(name: str) -> list[Constraint | Cost]:
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
                "path",
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
def make_problem(name: str) -> vkc.TrajectoryProblem:
    if name == "stick":
        scene = make_room(describe_table())
        steps = [vkc.Touch("stick.tip", (0.8, 0.9, 0.7)), vkc.Place("stick", (0.8, 0.5, 0.56))]
    elif name == "ball":
        scene = make_scene_with_held_stick()
        steps = [vkc.Grasp("ball", "pull", "stick.tip"), vkc.Place("ball", (0.8, 0.6, 0.7))]
    else:
        scene = make_full_scene()
        steps = [vkc.Actuate("cabinet", {"swing": 0.5}), vkc.Actuate("door", {"hinge": 1.2})]
    steps = [*steps, vkc.GoTo(0.0, 0.0)]
    return make_program(scene, steps, options=OPTIONS, terms=make_terms(name))


def make_drive(*terms: Constraint | Cost, held: bool = False) -> vkc.TrajectoryProblem:
    """Return a drive by 1 m, beside the stick or with it in the hand."""
    scene = make_room(describe_table())
    scene = scene.with_held({"stick": "grip"}) if held else scene
    return make_program(scene, [vkc.GoTo(1.0, 0.0)], options=OPTIONS, terms=terms)


NAMES = ["stick", "ball", "furniture"]


class NumericState:
    """Evaluates frames with the models of robot and objects, and grasps by their definition."""

    def __init__(
        self, p: vkc.TrajectoryProblem, path: np.ndarray, waypoint: int, dt: float
    ) -> None:
        self.p, self.path, self.t, self.dt = p, path, waypoint, dt
        self.ends = [0, *p.ends.tolist()]

    def _get_value(self, name: str, t: int) -> float:
        if name in self.p.chain.names:
            return float(self.path[t, self.p.chain.index(name)])
        owner, _, joint = name.partition(".")
        placed = self.p.scene.objects[owner]
        return float(placed.state[placed.object.coordinates.index(joint)])

    def _get_values(self, owner: str, names: Sequence[str], t: int) -> np.ndarray:
        return np.array([self._get_value(f"{owner}.{name}", t) for name in names])

    def _compute_placement(self, frame: str, t: int) -> pin.SE3:
        """Return the placement of a frame; a held base is at holder · (link · A · J(v) · D)⁻¹."""
        phase = self.p.task.phases[max(int(np.searchsorted(self.ends, t)) - 1, 0)]
        robot, (owner, dot, link) = self.p.scene.robot, frame.partition(".")
        if not dot:
            data = robot.model.createData()
            q = robot.coordinates.q(self.path[t, : len(robot.lower)])
            pin.framesForwardKinematics(robot.model, data, q)
            return data.oMf[robot.model.getFrameId(frame)].copy()
        placed = self.p.scene.objects[owner]
        hold = next((hold for hold in phase.held if hold.object == owner), None)
        if hold is None and owner in phase.released_by:
            hold, last = phase.released_by[owner]
            t = self.ends[last + 1]
        item, state = placed.object, self._get_values(owner, placed.object.coordinates.names, t)
        own = item.link_placement(link, state)
        if not item.free:
            return placed.placement * own
        if hold is None:
            return phase.resting[owner] * own
        grasp = item.attachments[hold.attachment]
        tool = grasp.tool(self._get_values(owner, grasp.coordinates, t))
        holder = self._compute_placement(str(hold.frame) if hold.by else robot.tool_frame, t)
        return holder * (item.link_placement(grasp.link, state) * tool).inverse() * own

    def position(self, frame: str) -> ca.DM:
        return ca.DM(self._compute_placement(frame, self.t).translation)

    def rotation(self, frame: str) -> ca.DM:
        return ca.DM(self._compute_placement(frame, self.t).rotation)

    def velocity(self, frame: str) -> ca.DM:
        before = self._compute_placement(frame, self.t - 1).translation
        return (self.position(frame) - before) / self.dt

    def coordinate(self, name: str) -> float:
        return self._get_value(name, self.t)

    def rate(self, name: str) -> float:
        return (self._get_value(name, self.t) - self._get_value(name, self.t - 1)) / self.dt


def compute_expected_values(
    p: vkc.TrajectoryProblem, term: Constraint | Cost, path: np.ndarray, dt: np.ndarray
) -> dict[int, np.ndarray]:
    """Return the term's value at every waypoint of its phases after their first."""
    found = {}
    for phase, first, last in zip(p.task.phases, [0, *p.ends[:-1]], p.ends, strict=True):
        if term.is_active(phase.name, [hold.object for hold in phase.held]):
            for t in range(int(first) + 1, int(last) + 1):
                value = term.expression(NumericState(p, path, t, dt[t - 1]))  # type: ignore[operator, arg-type]
                found[t] = np.asarray(ca.DM(value)).ravel()
    return found


@pytest.mark.parametrize("name", NAMES)
def test_rows_and_costs_equal_the_expressions_at_the_waypoints(name: str) -> None:
    """Their excess is relaxed like that of other rows, and their derivatives are exact."""
    p = make_problem(name)
    point, t, cost, count = make_random_point(p), p.transcription, 0.0, 0
    rows, dt = point.rows(), point.dt
    by_name = {term.name: at for term, at in zip(p.terms, t.term_rows, strict=True)}
    for term in make_terms(name):
        expected = compute_expected_values(p, term, point.path, dt)
        if isinstance(term, Cost):
            cost += term.weight * sum(float(value[0]) for value in expected.values())
        for waypoint, at in by_name.get(term.name, {}).items():
            excess = point.excess[at - t.first_relaxed_row]
            relaxed = expected[waypoint] - point.relaxation[waypoint - 1] * excess
            # the norm of a zero velocity is rounded to 1e-4
            atol = 1.01e-4 if term.name == "speed" else 1e-7
            np.testing.assert_allclose(rows[at], relaxed, atol=atol)
            count += len(at)
    assert count == len(p.term_evaluator.rows)
    squares = [
        np.sum(w * part**2)
        for w, part in zip(point.weights, p.rates(point.z, point.dt), strict=True)
    ]
    assert point.cost() == pytest.approx(cost + sum(squares) + point.penalties, rel=1e-6)
    steps = p.rates(point.z, point.dt)
    assert p.objective(point.z, dt) == pytest.approx(p.motion_cost.value(*steps) + cost, rel=1e-6)
    assert {name: len(at) for name, at in by_name.items()} == {
        # the stick cannot move before it is grasped
        "stick": {"tip": 9, "tilt": 3, "speed": 12, "near": 12, "elbow": 6, "waves": 0, "path": 0},
        "ball": {"between": 6, "ball": 6},
        "furniture": {"panel": 17, "look": 17, "tray": 17, "hinge": 17, "slide": 0},
    }[name]
    make_random_point(p, seed=2).check_derivatives()


@pytest.mark.parametrize("name", NAMES)
def test_fully_relaxed_constraints_hold_at_the_iterate(name: str) -> None:
    amounts = [
        check_relaxation(make_problem(name), z) for z in make_iterates(make_problem(name), 1)
    ]
    assert max(each["terms"] for each in amounts) > 0.1


def test_position_after_release_depends_on_the_waypoint_of_release() -> None:
    p = make_problem("stick")
    t, release = p.transcription, int(p.ends[2])
    at = next(at for term, at in zip(p.terms, t.term_rows, strict=True) if term.name == "near")
    row, column = (np.array(part) for part in t.jacobian.sparsity().get_triplet())
    is_coordinate = column % t.width < t.n
    for waypoint, rows in at.items():
        touched = set(column[np.isin(row, rows) & is_coordinate] // t.width + 1)
        assert touched == ({waypoint, release} if waypoint > release else {waypoint})


def test_programs_differ_by_expressions_but_not_by_bounds() -> None:
    def make_limited(limit: float, upper: float) -> vkc.TrajectoryProblem:
        near = vkc.Constraint("near", lambda s: s.position("tool")[2] - limit, upper=upper)
        return make_drive(near)

    first, without = make_limited(0.5, 1.0), make_drive()
    assert make_limited(0.5, 2.0).transcription is first.transcription
    assert make_limited(0.6, 1.0).transcription is not first.transcription
    assert first.transcription.rows == without.transcription.rows + OPTIONS.reach_waypoints
    assert first.term_evaluator.upper.tolist() == [1.0] * OPTIONS.reach_waypoints


def test_violations_are_scaled_by_their_tolerance() -> None:
    low = vkc.Constraint("low", lambda s: s.coordinate("base_x"), upper=0.5, tolerance=0.02)
    p = make_drive(low)
    z = p.still
    dt = p.timing_for(z).dt
    assert p.row_error(z, dt) == 0.0
    z[1, 0] = 0.54  # twice the tolerance
    assert p.row_error(z, dt) == pytest.approx(2e-3)
    assert p.pose_error(z) == 0.0
    z[1, 0] = np.nan
    assert p.term_evaluator.compute_violation(z, dt) == np.inf


@pytest.mark.parametrize(("run", "row"), [(0, 0), (0, -1), (1, 0), (1, -1)])
def test_speed_limits_lengthen_the_steps_between_two_stops(run: int, row: int) -> None:
    """The first or last step before or after a grasp is too fast."""

    def make_limited(**limits: float) -> vkc.TrajectoryProblem:
        speed = vkc.Constraint("speed", lambda s: s.velocity("tool")[0], tolerance=1e-3, **limits)
        steps = [vkc.Grasp("stick"), vkc.GoTo(1.0, 0.0)]
        return make_program(make_room(describe_stand()), steps, options=OPTIONS, terms=[speed])

    unlimited, limited = make_limited(upper=9.0), make_limited(upper=0.1)
    (stop,) = unlimited.transcription.structure.stops
    own = np.split(np.arange(unlimited.segments), [stop])[run]
    z = unlimited.still
    z[own[row] :, 0] += 0.1
    before, after = unlimited.timing_for(z), limited.timing_for(z)
    ratio, needed = after.dt / before.dt, 1.0 / before.dt[own[row]]
    assert needed > 1.2
    assert ((0.99 * needed <= ratio) & (ratio <= 1.2 * needed))[own].all()
    assert (np.delete(ratio, own) == 1.0).all()
    assert limited.term_evaluator.compute_violation(z, after.dt) <= 1e-3
    np.testing.assert_allclose(after.velocity, limited.chain.velocity * after.dt[:, None])
    infeasible = make_limited(lower=0.05, upper=0.1)  # the lower bound is violated at rest
    assert (infeasible.timing_for(z).dt <= 8.0 * before.dt).all()


@pytest.mark.parametrize(
    "expression",
    [
        lambda s: ca.acos(s.rotation("stick.stick")[2, 2]),
        lambda s: 1 / ca.sumsqr(s.velocity("tool")),
    ],
    ids=["derivative", "value"],
)
@pytest.mark.parametrize(
    "make_term", [lambda e: vkc.Constraint("mine", e, upper=0.2), lambda e: vkc.Cost("mine", e)]
)
def test_terms_that_are_not_finite_are_rejected(expression: Any, make_term: Any) -> None:
    message = "its value or derivative is not finite at the start"
    with pytest.raises(vkc.InputError, match=rf"terms\['mine'\]\.expression: {message}"):
        make_drive(make_term(expression), held=True)


def test_constant_terms_have_no_rows() -> None:
    here = vkc.Constraint("here", lambda s: s.position("stick.tip"), upper=-9.0, during="go to")
    assert make_drive(here).terms == ()
