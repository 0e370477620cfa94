"""Tests that failures name the constraint, links or coordinate, waypoint and amount."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.carrying import describe_box
from helpers.drawers import add_boxes
from helpers.drives import make_hall
from helpers.small_problems import load_door_scene

import vkc_pin as vkc

QUICK = vkc.Options(
    reach_waypoints=15, turn_waypoints=4, move_waypoints=12, max_restarts=1, max_outer=8
)


def plan_failure(scene: vkc.Scene, *steps: vkc.steps.Step, texts: Sequence[str]) -> vkc.Plan:
    """Plan an infeasible task; check that all violations have a waypoint and an amount."""
    plan = vkc.plan(scene, steps, options=QUICK)
    assert not plan.success
    assert plan.status == "infeasible"
    assert plan.report.violations
    for violation in plan.report.violations:
        assert violation.subject
        assert violation.amount > 0.0
        assert 0 <= violation.waypoint < len(plan.trajectory.times)
        assert 0.0 <= violation.time <= plan.trajectory.times[-1]
        assert f"waypoint {violation.waypoint}" in str(violation)
    report = plan.summary()
    assert report.splitlines()[0].startswith(f"{plan.scene.name}: FAILED, infeasible — ")
    for text in texts:
        assert text in report, report
    assert not vkc.validate(plan.scene, plan.steps, plan.trajectory, plan.options).ok
    return plan


def find_violation(plan: vkc.Plan, constraint: str, subject: str) -> vkc.Violation:
    """Return the violation of a constraint whose subject contains `subject`."""
    found = [
        v for v in plan.report.violations if v.constraint == constraint and subject in v.subject
    ]
    assert found, plan.summary()
    return found[0]


@pytest.mark.long
def test_wall_that_blocks_a_door_is_named() -> None:
    scene = add_boxes(load_door_scene(), barrier=((0.1, 1.07, 2.0), (2.3, 0.0, 1.0)))
    texts = ("because reach door.handle", "are blocked", "– barrier", "mm")
    plan = plan_failure(scene, vkc.Actuate("door", {"hinge": 1.2}), texts=texts)
    assert find_violation(plan, "penetration", "– barrier").unit == "m"


def test_partly_blocked_door_reports_its_free_range() -> None:
    """At 1.4 rad the hand on the lever does not fit between the door and the wall."""
    scene = add_boxes(load_door_scene(), beside=((1.2, 0.05, 2.2), (1.85, 0.59, 1.1)))
    texts = ("because move door.hinge", "– beside", "free configurations")
    plan = plan_failure(scene, vkc.Actuate("door", {"hinge": -1.4}, "handle"), texts=texts)
    found = float(plan.summary().split("were found up to hinge = ")[1].split()[0])
    assert -1.3 < found < -1.1
    assert vkc.plan(scene, [vkc.Actuate("door", {"hinge": found})], options=QUICK).success
    task = vkc.GoTo(0.0, 0.0), vkc.Actuate("door", {"hinge": -1.4}, "handle"), vkc.GoTo(-1.0, 0.0)
    plan = plan_failure(scene, *task, texts=texts)
    phases = ["go to", "reach door.handle", "turn door.knob", "move door.hinge, door.knob"]
    assert [phase.name for phase in plan.trajectory.phases] == phases  # the rest cannot help


@pytest.mark.parametrize(
    ("step", "subject", "unit", "beyond", "text"),
    [
        (vkc.Actuate("door", {"hinge": 2.0}), "door.hinge", "rad", 0.43, "2 rad is beyond the li"),
        (vkc.Actuate("door", {"knob": -0.5}), "door.knob", "rad", 0.5, "-0.5 rad is beyond the l"),
        (vkc.GoTo(6.5, -3.0), "base_x", "m", 1.3, "6.5 m is beyond the limits -2.6 to 5.2 m by 1"),
        (vkc.GoTo(6.5, -3.0), "base_y", "m", 0.9, "-3 m is beyond the limits -2.1 to 2.1 m by 0.9"),
    ],
)
def test_goal_beyond_a_limit(
    step: vkc.steps.Step, subject: str, unit: str, beyond: float, text: str
) -> None:
    plan = plan_failure(load_door_scene(), step, texts=[f"goal {subject}: {text}"])
    goal = find_violation(plan, "goal", subject)
    assert (goal.subject, goal.unit) == (subject, unit)
    assert goal.amount == pytest.approx(beyond)
    # The time is that of the plan's motion, not of the program.
    assert goal.time == pytest.approx(plan.trajectory.times[-1], abs=2e-3)
    assert plan.metrics["rounds"] == 0  # the solver did not run


@pytest.mark.parametrize("arguments", [{"simultaneous": False}, {"window": 1}])
def test_later_goal_beyond_a_limit(arguments: dict[str, Any]) -> None:
    steps = [vkc.GoTo(0.0, 0.0), vkc.GoTo(6.5, 0.0)]
    plan = vkc.plan(load_door_scene(), steps, options=QUICK, **arguments)
    assert plan.status == "infeasible"
    reason = "goal base_x: 6.5 m is beyond the limits -2.6 to 5.2 m by 1.3 m"
    assert plan.report.notes[-1] == reason
    assert f"because {reason}" in plan.summary()


@pytest.mark.parametrize(
    "step", [vkc.Actuate("door", {"knob": np.float32(0.8)}), vkc.GoTo(0.5, -2.1 - 1e-7, 0.0)]
)
def test_goal_beyond_a_limit_by_rounding_is_clamped(step: vkc.steps.Step) -> None:
    scene = load_door_scene()
    document = {**scene.document, "obstacles": []}
    scene = vkc.Scene.from_document(document, scene.folder)
    plan = vkc.plan(scene, [step], options=QUICK)
    assert plan.success, plan.summary()
    assert vkc.plan(plan.end_scene(), [vkc.GoTo(0.0, 0.0)], options=QUICK).success


def test_target_out_of_reach(tmp_path: Path) -> None:
    texts = ("because reach with tool: out of reach, proven: ", "1.25 m too high or low", "m long")
    plan = plan_failure(make_hall(), vkc.Reach((1.5, 0.0, 3.0, 0.0, 0.0, 0.0)), texts=texts)
    goal = find_violation(plan, "goal", "tool")
    assert goal.amount == pytest.approx(2.3135, abs=1e-3)  # the motion is stationary
    assert goal.waypoint == len(plan.trajectory.times) - 1
    loaded = vkc.Plan.load(plan.save(tmp_path / "failed.npz"))
    assert not loaded.success
    assert loaded.summary() == plan.summary()


def test_height_of_the_base_is_fixed() -> None:
    texts = ["base_link at z = 1.00 m is 0.98 m too high or low, since the base keeps it at z = 0"]
    plan_failure(make_hall(), vkc.Reach((1.5, 0.0, 1.0, 0.0, 0.0, 0.0), "base_link"), texts=texts)


def test_goal_slightly_out_of_reach() -> None:
    """The figure of a proof has three digits, so that it never reads "0.00 m too high"."""
    touch = vkc.Touch("forearm_link", (0.5, 0.5, 1.0))
    texts = ["because touch with forearm_link: out of reach, proven: "]
    report = plan_failure(make_hall(), touch, texts=texts).summary()
    beyond = float(report.split("at z = 1.00 m is ")[1].split()[0])
    assert 0.0 < beyond < 0.005


@pytest.mark.parametrize(
    ("x", "text", "amount"),
    [(0.5, "overlap by 195.0 mm", 0.195), (0.495 + 0.2, "touch", 0.0)],  # the base's front is 0.495
)
def test_start_in_collision(x: float, text: str, amount: float) -> None:
    crate = describe_box("crate", (0.4, 0.4, 0.4), (x, 0.0, 0.2))
    texts = [f"start base_link – crate: {text} at the start", "goal base_x"]
    plan = plan_failure(make_hall(obstacles=[crate]), vkc.GoTo(9.0, 0.0), texts=texts)
    start = find_violation(plan, "start", "base_link – crate")
    assert start.waypoint == 0
    assert start.amount == pytest.approx(amount, abs=1e-3)


CRATE = describe_box("crate", (0.6, 0.6, 0.4), (1.5, 0.0, 0.2))
FENCE = describe_box("fence", (0.1, 12.0, 2.4), (1.2, 0.0, 1.2))
SHELF = describe_box("shelf", (0.4, 2.0, 1.0), (5.0, 3.0, 0.5))


@pytest.mark.parametrize(
    ("obstacles", "step", "texts"),
    [
        (
            [FENCE, SHELF],
            vkc.GoTo(3.0, 0.0),
            ["no path for the base, proven: at any heading, with the arm anywhere", "by fence"],
        ),
        (
            [FENCE, SHELF],
            vkc.Reach((3.0, 0.0, 1.0, 0.0, np.pi / 2, 0.0)),
            ["no path for the base, proven: at any heading, with the arm anywhere", "by fence"],
        ),
        (
            [CRATE],
            vkc.GoTo(1.5, 0.0, 0.0),
            ["because go to: no place for the base, proven: ", "it hits crate"],
        ),
        (
            [FENCE, describe_box("block", (0.6, 0.6, 0.4), (3.0, 0.0, 0.2))],
            vkc.GoTo(3.0, 0.0, 0.0),
            ["because go to: no place for the base, proven: ", "any heading, it hits block"],
        ),
    ],
    ids=["drive behind a fence", "reach behind a fence", "into a crate", "into one behind a fence"],
)
def test_unreachable_base_goal(
    obstacles: list[dict[str, Any]], step: vkc.steps.Step, texts: list[str]
) -> None:
    plan = plan_failure(make_hall(obstacles=obstacles), step, texts=texts)
    assert plan.metrics["rounds"] == 0  # the solver did not run
    assert find_violation(plan, "goal", "").waypoint == len(plan.trajectory.times) - 1
