"""Tests the validation of user constraints with violations known from geometry."""

from __future__ import annotations

import dataclasses
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.carrying import STICK, TOP, describe_table, make_carrying_motion, make_room
from helpers.drives import DT, drive_through, make_hall, make_trajectory, move_start

import vkc_pin as vkc
from vkc_pin.validation.terms import INTERMEDIATE_FACTOR
from vkc_pin.world.task.steps import Step

START = make_hall().start


def find_violations(
    motion: vkc.Trajectory,
    term: vkc.Constraint,
    *steps: Step,
    scene: vkc.Scene | None = None,
    **fields: Any,
) -> list[vkc.Violation]:
    """Return the violations of one constraint with other fields."""
    steps = steps or (vkc.GoTo(*motion.positions[-1, :2]),)
    terms = [dataclasses.replace(term, **fields)]
    report = vkc.validate(scene or make_hall(), steps, motion, terms=terms)
    return [violation for violation in report.violations if violation.constraint == "term"]


def test_constraint_on_a_grasped_object_is_checked() -> None:
    scene, low = make_room(describe_table()), TOP + 0.1
    motion, place = make_carrying_motion(scene, aside=0.3).motion(), (0.8, 0.3, 0.551)

    def find(upper: float, **fields: Any) -> list[vkc.Violation]:
        term = vkc.Constraint(
            "low tip", lambda s: s.position("stick.tip")[2], upper=upper, **fields
        )
        return find_violations(motion, term, vkc.Place("stick", place), scene=scene)

    link = scene.objects["stick"].object.link_placement("tip", [])
    highest = (STICK * link).translation[2] + 0.2
    assert find(highest + 1e-4) == []
    (violation,) = find(low)
    assert (violation.subject, violation.unit) == ("low tip", "")
    assert violation.amount == pytest.approx(highest - low, abs=1e-6)
    assert f"{highest:.6g} is more than 0.6 by" in violation.detail
    held = [phase for phase in motion.phases if phase.held]
    assert motion.times[held[0].first] <= violation.time <= motion.times[held[-1].last]
    # The constraint holds before and after the transport.
    assert find(low, during=[motion.phases[0].name, motion.phases[-1].name]) == []
    assert len(find(low, holding="stick")) == 1


def test_worst_violation_is_reported_with_entry_and_time() -> None:
    scene = make_hall()
    motion = drive_through(scene, START, move_start(START, x=2.0), move_start(START, x=2.0, y=1.0))
    within = vkc.Constraint(
        "within",
        lambda s: ca.vertcat(s.coordinate("base_x"), s.position("base_link")[1]),
        upper=[1.5, 0.25],
    )
    (violation,) = find_violations(motion, within)
    assert violation.amount == pytest.approx(0.75, abs=1e-9)
    assert violation.waypoint == len(motion.times) - 1
    assert violation.time == pytest.approx(motion.times[-1])
    assert violation.detail == "entry 1: 1 is more than 0.25 by 0.75"
    (violation,) = find_violations(motion, within, during="drive 1")
    assert violation.detail == "entry 0: 2 is more than 1.5 by 0.5"
    assert violation.waypoint == 40
    far = vkc.Cost("far", lambda s: s.coordinate("base_x"))
    assert vkc.validate(scene, [vkc.GoTo(2.0, 1.0)], motion, terms=[far]).ok


@pytest.mark.parametrize(
    ("bound", "excess", "violated"),
    [("lower", 5e-4, False), ("upper", 5e-4, False), ("upper", 2e-3, True)],
)
def test_violation_at_waypoints_beyond_the_tolerance_is_reported(
    bound: str, excess: float, violated: bool
) -> None:
    motion = drive_through(make_hall(), START, move_start(START, x=2.0))
    sign, limit = (1.0, 2.0 - excess) if bound == "upper" else (-1.0, excess - 2.0)
    term = vkc.Constraint("x", lambda s: sign * s.coordinate("base_x"), **{bound: limit})
    assert len(find_violations(motion, term)) == violated
    assert find_violations(motion, term, tolerance=2 * excess) == []


@pytest.mark.parametrize(("turn", "violated"), [(0.2, False), (0.6, True)])
def test_violation_between_waypoints_beyond_the_tolerance_is_reported(
    turn: float, violated: bool
) -> None:
    """The hand swings out by r·(1 − cos(turn/2)) in the middle of a turn of the base."""
    scene = make_hall()
    arm = scene.tool_placement().translation
    ahead, away = np.arctan2(arm[1], arm[0]), float(np.hypot(*arm[:2]))
    rows = [START, *(move_start(START, yaw=-ahead + sign * turn / 2) for sign in (-1.0, 1.0))]
    motion = make_trajectory(scene, np.array(rows), dt=5.0)
    edge = away * np.cos(turn / 2)
    term = vkc.Constraint("behind", lambda s: s.position("tool")[0], upper=edge)
    out = away - edge
    assert (out > INTERMEDIATE_FACTOR * term.tolerance) == violated
    violations = find_violations(motion, term)
    assert len(violations) == violated
    for violation in violations:
        assert violation.amount == pytest.approx(out, rel=1e-3)
        assert violation.waypoint == 1
        assert violation.time == pytest.approx(7.5, abs=0.1)
        assert "between waypoints" in violation.detail
    tolerance = out / INTERMEDIATE_FACTOR * 0.9
    assert len(find_violations(motion, term, tolerance=tolerance)) == 1


def test_velocities_at_waypoints_are_those_of_the_segment_before() -> None:
    scene = make_hall()
    motion = drive_through(scene, START, move_start(START, x=2.0))
    speeds = np.abs(np.diff(motion.positions[:, 0])) / DT
    fastest = float(speeds.max())
    for frame in ("tool", "base_link"):
        slow = vkc.Constraint(
            "slow", lambda s, frame=frame: ca.norm_2(s.velocity(frame)), upper=fastest + 1e-4
        )
        assert find_violations(motion, slow) == []
        (violation,) = find_violations(motion, slow, upper=0.9 * fastest)
        assert violation.amount == pytest.approx(0.1 * fastest, rel=1e-3)
        assert violation.waypoint in np.flatnonzero(speeds > 0.999 * fastest) + 1
    rate = vkc.Constraint("rate", lambda s: s.rate("base_x"), upper=0.9 * fastest)
    assert find_violations(motion, rate)[0].amount == pytest.approx(0.1 * fastest, rel=1e-6)
    # Rates do not jump at waypoints, so that no violation between them exceeds those at both.
    brakes = vkc.Constraint(
        "brakes", lambda s: s.rate("base_x") - 0.2 * (2.0 - s.coordinate("base_x")), upper=0.0
    )
    values = speeds - 0.2 * (2.0 - motion.positions[1:, 0])
    assert values.max() > 0.1
    (violation,) = find_violations(motion, brakes)
    assert violation.amount == pytest.approx(values.max(), abs=1e-3)


def test_constraint_holds_after_the_first_waypoint_of_its_phases() -> None:
    motion = drive_through(make_hall(), START, move_start(START, x=2.0), move_start(START, x=2.5))
    ahead = vkc.Constraint("ahead", lambda s: s.coordinate("base_x"), lower=2.0)
    for lower, during, count in (
        (2.0, None, 1),
        (2.0, "drive 2", 0),
        (motion.positions[41, 0], "drive 2", 0),  # although the phase begins before that
        (motion.positions[41, 0], ["drive 1", "drive 2"], 1),
    ):
        assert len(find_violations(motion, ahead, lower=lower, during=during)) == count


def test_constraint_holds_after_the_wait_for_the_gripper() -> None:
    scene = make_hall()
    stops = (move_start(START, x=1.0), move_start(START, x=2.0))
    driven = drive_through(scene, START, *stops, steps=10)
    rows = np.vstack([driven.positions[:11], driven.positions[10:]])  # rests for a step
    phases = (vkc.PhaseSpan("drive 1", 0, 10), vkc.PhaseSpan("drive 2", 10, 21))
    motion = make_trajectory(scene, rows, dt=0.5, phases=phases)
    ahead = vkc.Constraint(
        "ahead", lambda s: s.coordinate("base_x"), lower=rows[12, 0], during="drive 2"
    )
    assert find_violations(motion, ahead) == []
    assert len(find_violations(motion, ahead, lower=rows[13, 0])) == 1
    still = dataclasses.replace(
        motion, positions=np.vstack([rows[:11], np.tile(rows[10], (11, 1))])
    )
    # A base that never moves does not satisfy it.
    assert len(find_violations(still, ahead, vkc.GoTo(1.0, 0.0))) == 1


def test_constraint_holds_where_the_robot_passes_its_start_again() -> None:
    rows = np.array([move_start(START, x=x) for x in (0.0, 1.0, 0.0, 1.0)])
    motion = make_trajectory(make_hall(), rows, dt=5.0)
    ahead = vkc.Constraint("ahead", lambda s: s.coordinate("base_x"), lower=0.5)
    (violation,) = find_violations(motion, ahead)
    assert (violation.waypoint, violation.amount) == (2, pytest.approx(0.5))


def test_nan_is_a_violation() -> None:
    motion = drive_through(make_hall(), START, move_start(START, x=2.0))
    term = vkc.Constraint("log", lambda s: ca.log(s.coordinate("base_x") - 1.0), lower=-100.0)
    (violation,) = find_violations(motion, term)
    assert violation.amount == np.inf
    assert "nan" in violation.detail
