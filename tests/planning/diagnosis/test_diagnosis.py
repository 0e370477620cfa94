from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import pytest
from helpers.carrying import (
    STICK,
    compute_grasp_pose,
    describe_box,
    describe_table,
    make_room,
    solve_above,
    solve_reach,
)
from helpers.drawers import add_boxes, load_drawer_scene
from helpers.drives import make_hall
from helpers.litter import BELOW_SHELF, describe_shelf, make_littered_scene
from helpers.small_problems import SHORT, load_door_scene, make_program

import vkc_pin as vkc
from vkc_pin.planning.diagnosis.diagnosis import (
    BlockedGoal,
    describe_free_range,
    diagnose_goal,
    diagnose_goals,
    find_impossible_conditions,
)
from vkc_pin.validation.report import Violation

CRATE = describe_box("crate", [0.6, 0.6, 0.4], [1.5, 0.0, 0.2])


def make_problem(scene: vkc.Scene, *steps: vkc.steps.Step) -> vkc.TrajectoryProblem:
    return make_program(scene, list(steps), options=SHORT)


def test_goal_at_the_limit_is_allowed() -> None:
    scene = load_door_scene()
    steps = [vkc.Actuate("door", {"hinge": 1.57}), vkc.GoTo(scene.arena[1], scene.arena[3])]
    assert find_impossible_conditions(make_problem(scene, *steps)) == []


def hold_stick_above_table(*obstacles: dict[str, Any]) -> list[Violation]:
    """Return the violations at the start of a robot that holds the stick on a table."""
    down = solve_reach(compute_grasp_pose(STICK), solve_above(STICK))
    scene = make_room(*obstacles).with_start(base=down[:3], arm=down[3:])
    held = scene.with_held({"stick": "grip"})
    return find_impossible_conditions(make_problem(held, vkc.GoTo(0.0, 1.0)))


@pytest.mark.parametrize("gap", [1e-3, 0.0, -2e-3])
def test_attached_object_may_rest_on_another_at_the_start(gap: float) -> None:
    assert hold_stick_above_table(describe_table(gap=gap)) == []


def test_robot_with_an_attached_object_may_not_start_inside_a_block() -> None:
    """The block is around the base."""
    x, y, _ = solve_reach(compute_grasp_pose(STICK), solve_above(STICK))[:3].tolist()
    block = describe_box("block", [0.2, 0.2, 0.2], [x, y, 0.3])
    found = hold_stick_above_table(describe_table(gap=-2e-3), block)
    assert {violation.constraint for violation in found} == {"start"}


def test_residual_of_an_unreachable_target_is_reported() -> None:
    target = make_problem(make_hall(), vkc.Reach((1.0, 0.0, 4.0, 0.0, 0.0, 0.0)))
    (goal,) = diagnose_goals(target, 0)
    assert goal.text.startswith("reach with tool: out of reach")
    nearest = float(goal.text.split("the nearest stays ")[1].split()[0])
    assert nearest == pytest.approx(goal.shortfall, abs=1e-3)
    assert 1.5 < goal.shortfall < 3.0
    assert goal.is_deep
    assert diagnose_goals(target, 0) == [goal]


def test_obstacles_of_all_goal_configurations_are_reported_by_phase() -> None:
    drives = (vkc.GoTo(0.2, 0.0, 0.0), vkc.GoTo(1.5, 0.0, 0.0))
    two = make_problem(make_hall(obstacles=[CRATE]), *drives)
    assert diagnose_goal(two, 0, 0) is None
    (goal,) = diagnose_goals(two, 0)
    assert goal == diagnose_goal(two, 1, 0)
    assert goal.text.endswith("base_link – crate overlap by 270.0 mm")
    assert goal.shortfall == pytest.approx(0.27 + SHORT.dist_safe)


def test_grasp_is_free_when_placing() -> None:
    """Under a shelf the object can be placed from the side only, with another grasp."""
    scene = make_littered_scene(describe_shelf(*BELOW_SHELF[:2]))
    below = make_problem(scene, vkc.Place("litter", BELOW_SHELF, "grip"))
    assert [phase.kind for phase in below.task.phases] == ["grasp", "place"]
    assert diagnose_goal(below, 1, 0) is None


@pytest.mark.parametrize(("missing", "free"), [(-1e-4, True), (4e-4, True), (1e-3, False)])
def test_tolerance_matches_the_solver(missing: float, free: bool) -> None:
    """The base is near a crate with a given shortfall [m]; the solver accepts 0.5 mm."""
    scene = make_hall(obstacles=[CRATE])
    front = 1.5 - 0.3 - 0.495
    stop = make_problem(scene, vkc.GoTo(front - vkc.Options().dist_safe + missing, 0.0, 0.0))
    found = diagnose_goal(stop, 0, 0)
    assert (found is None) == free
    if found is not None:
        assert "base_link – crate" in found.text
        assert found.shortfall == pytest.approx(missing, abs=1e-5)


def make_far_drawer(x: float = 0.4) -> vkc.Scene:
    """Return an open drawer that a robot with a fixed base does not reach once it is closed."""
    document = copy.deepcopy(dict(load_drawer_scene().document))
    del document["start_region"]
    document["objects"][0]["state"] = {"slide": 0.3}
    document["robot"] = {"name": "husky_ur5e", "base": "fixed"}
    return vkc.Scene.from_document({**document, "start": {"base": [x, 0, 0], "arm": "home"}})


def make_door_beside_a_wall() -> vkc.Scene:
    """Return a door beside a wall that leaves too little room for the hand on the lever."""
    return add_boxes(load_door_scene(), wall=((1.2, 0.05, 2.2), (1.85, 0.59, 1.1)))


@pytest.mark.parametrize(
    ("make_scene", "name", "goal", "cause"),
    [
        (make_far_drawer, "drawer.slide", 0.0, "out of reach"),
        pytest.param(make_door_beside_a_wall, "door.hinge", -1.4, "– wall", marks=pytest.mark.long),
    ],
)
def test_range_of_a_blocked_joint(
    make_scene: Callable[[], vkc.Scene], name: str, goal: float, cause: str
) -> None:
    """Goals up to the end of the range have free configurations, goals a little beyond do not."""
    scene, (owner, _, joint) = make_scene(), name.partition(".")

    def diagnose(value: float) -> list[BlockedGoal]:
        return diagnose_goals(make_problem(scene, vkc.Actuate(owner, {joint: value})), 0)

    (blocked,) = diagnose(goal)
    assert cause in blocked.text
    problem = make_problem(scene, vkc.Actuate(owner, {joint: goal}))
    text = describe_free_range(problem, blocked.phase, 0)
    sign, value, unit = text.removeprefix(joint).split()
    assert (sign, unit) == ("=", problem.unit(name))
    beyond = 0.06 * (goal - problem.task.phases[0].initial_values[name])
    assert diagnose(float(value)) == []
    assert diagnose(float(value) + beyond) != []


def test_no_range_is_described_without_free_configurations() -> None:
    problem = make_problem(make_far_drawer(-0.5), vkc.Actuate("drawer", {"slide": 0.0}))
    assert [describe_free_range(problem, number, 0) for number in (0, 1)] == ["", ""]
