"""Tests that failures name the constraint, links or coordinate, waypoint and amount."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from helpers.drives import make_hall

import vkc_pin as vkc

QUICK = vkc.Options(
    reach_waypoints=15, turn_waypoints=4, move_waypoints=12, max_restarts=1, max_outer=8
)


def describe_box(name: str, size: Sequence[float], position: Sequence[float]) -> dict[str, Any]:
    return {"name": name, "type": "box", "size": list(size), "position": list(position)}


def add_obstacles(*obstacles: dict[str, Any]) -> vkc.Scene:
    scene = vkc.load_scene("door")
    document = {**scene.document, "obstacles": [*scene.document["obstacles"], *obstacles]}
    return vkc.Scene.from_document(document, scene.folder)


def check_explanation(plan: vkc.Plan, *texts: str) -> str:
    """Check that the plan failed and that all violations have a waypoint and an amount."""
    assert not plan.success
    assert plan.status in ("infeasible", "not converged", "rejected")
    assert plan.report.violations
    for violation in plan.report.violations:
        assert violation.subject
        assert violation.amount > 0.0
        assert 0 <= violation.waypoint < len(plan.trajectory.times)
        assert 0.0 <= violation.time <= plan.trajectory.times[-1]
        assert f"waypoint {violation.waypoint}" in str(violation)
    report = plan.summary()
    assert report.splitlines()[0].startswith(f"{plan.scene.name}: FAILED, {plan.status} — ")
    for text in texts:
        assert text in report, report
    assert not vkc.validate(plan.scene, plan.steps, plan.trajectory, plan.options).ok
    return report


def find_violation(plan: vkc.Plan, constraint: str, subject: str) -> vkc.Violation:
    """Return the violation of a constraint whose subject contains `subject`."""
    found = [
        v for v in plan.report.violations if v.constraint == constraint and subject in v.subject
    ]
    assert found, plan.summary()
    return found[0]


@pytest.mark.long
def test_wall_that_blocks_a_door_is_named() -> None:
    scene = add_obstacles(describe_box("barrier", (0.1, 1.07, 2.0), (2.3, 0.0, 1.0)))
    plan = vkc.plan(scene, [vkc.Actuate("door", {"hinge": 1.2})], options=QUICK)
    assert plan.status == "infeasible"
    check_explanation(plan, "because reach door.handle", "are blocked", "– barrier", "mm")
    assert find_violation(plan, "penetration", "– barrier").unit == "m"


def test_partly_blocked_door_reports_its_free_range() -> None:
    """At 1.4 rad the hand on the lever does not fit between the door and the wall."""
    scene = add_obstacles(describe_box("beside", (1.2, 0.05, 2.2), (1.85, 0.59, 1.1)))
    plan = vkc.plan(scene, [vkc.Actuate("door", {"hinge": -1.4}, "handle")], options=QUICK)
    assert plan.status == "infeasible"
    report = check_explanation(plan, "because move door.hinge", "– beside", "free configurations")
    found = float(report.split("were found up to hinge = ")[1].split()[0])
    assert -1.3 < found < -1.1
    assert vkc.plan(scene, [vkc.Actuate("door", {"hinge": found})], options=QUICK).success


@pytest.mark.parametrize(
    ("joints", "name", "beyond"),
    [({"hinge": 2.0}, "door.hinge", 0.43), ({"knob": -0.5}, "door.knob", 0.5)],
)
def test_goal_beyond_a_joint_limit(joints: dict[str, float], name: str, beyond: float) -> None:
    plan = vkc.plan(vkc.load_scene("door"), [vkc.Actuate("door", joints)], options=QUICK)
    assert plan.status == "infeasible"
    check_explanation(
        plan, f"goal {name}: {next(iter(joints.values())):g} rad is beyond the limits"
    )
    first = plan.report.violations[0]
    assert (first.constraint, first.subject, first.unit) == ("goal", name, "rad")
    assert first.amount == pytest.approx(beyond)
    assert plan.metrics["rounds"] == 0  # the solver did not run


def test_goal_outside_the_arena() -> None:
    plan = vkc.plan(make_hall(), [vkc.GoTo(9.0, -6.5)], options=QUICK)
    assert plan.status == "infeasible"
    check_explanation(
        plan,
        "goal base_x: 9 m is beyond the limits -6 to 6 m by 3 m",
        "goal base_y: -6.5 m is beyond the limits -6 to 6 m by 0.5 m",
    )
    goal = find_violation(plan, "goal", "base_x")
    assert goal.waypoint == QUICK.reach_waypoints
    assert goal.time == plan.trajectory.times[-1]  # in the plan's motion, not in the program


def test_target_out_of_reach() -> None:
    plan = vkc.plan(make_hall(), [vkc.Reach((1.5, 0.0, 3.0, 0.0, 0.0, 0.0))], options=QUICK)
    assert plan.status == "infeasible"
    check_explanation(
        plan,
        "because reach with tool: out of reach, proven: ",
        "1.25 m too high or low",
        "goal tool",
    )
    goal = find_violation(plan, "goal", "tool")
    assert goal.amount == pytest.approx(2.3135, abs=1e-3)  # the motion is stationary
    assert goal.waypoint == len(plan.trajectory.times) - 1


def test_goal_slightly_out_of_reach() -> None:
    """The figure of a proof has three digits, so that it never reads "0.00 m too high"."""
    plan = vkc.plan(make_hall(), [vkc.Touch("forearm_link", (0.5, 0.5, 1.0))], options=QUICK)
    report = check_explanation(plan, "because touch with forearm_link: out of reach, proven: ")
    beyond = float(report.split("at z = 1.00 m is ")[1].split()[0])
    assert 0.0 < beyond < 0.005


def test_start_in_collision() -> None:
    plan = vkc.plan(
        make_hall(obstacles=[describe_box("crate", (0.4, 0.4, 0.4), (0.5, 0.0, 0.2))]),
        [vkc.GoTo(-1.0, 0.0)],
        options=QUICK,
    )
    assert plan.status == "infeasible"
    check_explanation(
        plan, "start base_link – crate: overlap by 195.0 mm at the start (waypoint 0, 0.00 s)"
    )
    first = plan.report.violations[0]
    assert (first.constraint, first.subject, first.waypoint) == ("start", "base_link – crate", 0)
    assert first.amount == pytest.approx(0.195, abs=1e-3)


def test_start_in_contact_with_an_obstacle() -> None:
    crate = describe_box("crate", (0.4, 0.4, 0.4), (0.495 + 0.2, 0.0, 0.2))  # in front of the base
    plan = vkc.plan(make_hall(obstacles=[crate]), [vkc.GoTo(-1.0, 0.0)], options=QUICK)
    assert plan.status == "infeasible"
    check_explanation(plan, "start base_link – crate: touch at the start")


FENCE = [describe_box("fence", (0.1, 12.0, 2.4), (1.2, 0.0, 1.2))]


@pytest.mark.parametrize(
    "step",
    [vkc.GoTo(3.0, 0.0), vkc.Reach((3.0, 0.0, 1.0, 0.0, np.pi / 2, 0.0))],
    ids=["base", "reach"],
)
def test_goal_behind_a_fence_has_no_base_path(step: Any) -> None:
    plan = vkc.plan(make_hall(obstacles=FENCE), [step], options=QUICK)
    assert plan.status == "infeasible"
    check_explanation(
        plan,
        "no path for the base, proven: at any heading, with the arm anywhere",
    )
    assert plan.metrics["rounds"] == 0  # the solver did not run
    assert find_violation(plan, "goal", "").waypoint == len(plan.trajectory.times) - 1


def test_base_goal_inside_an_obstacle() -> None:
    crate = describe_box("crate", (0.6, 0.6, 0.4), (1.5, 0.0, 0.2))
    plan = vkc.plan(make_hall(obstacles=[crate]), [vkc.GoTo(1.5, 0.0, 0.0)], options=QUICK)
    assert plan.status == "infeasible"
    check_explanation(plan, "because go to: no place for the base, proven: ", "it hits crate")


def test_all_reasons_are_reported() -> None:
    scene = make_hall(obstacles=[describe_box("crate", (0.4, 0.4, 0.4), (0.5, 0.0, 0.2))])
    plan = vkc.plan(scene, [vkc.GoTo(9.0, 0.0)], options=QUICK)
    check_explanation(plan, "start base_link – crate", "goal base_x")


def test_failed_plan_is_saved_with_its_reasons(tmp_path: Any) -> None:
    plan = vkc.plan(make_hall(), [vkc.Reach((1.5, 0.0, 3.0, 0.0, 0.0, 0.0))], options=QUICK)
    loaded = vkc.Plan.load(plan.save(tmp_path / "failed.npz"))
    assert not loaded.success
    assert loaded.summary() == plan.summary()
