"""Tests plans with user constraints and costs, measured on the plain world model."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import describe_box
from helpers.drawers import make_drawer_scene, replace_scene_fields
from helpers.drives import make_hall

import vkc_pin as vkc
from vkc_pin.cli import main
from vkc_pin.world.trajectory.world_model import World

SHORT = vkc.Options(reach_waypoints=16)
STEPS = [vkc.Place("cup", [1.35, 1.1, 0.501])]
PERSON = np.array([0.0, 0.6, 1.2])

UPRIGHT = vkc.Constraint(
    "upright cup", lambda s: s.rotation("cup.cup")[2, 2], lower=0.98, during=["place cup"]
)
SLOW = vkc.Constraint(
    "slow near people",
    lambda s: ca.norm_2(s.velocity("tool")) - 0.5 * (ca.norm_2(s.position("tool") - PERSON) - 0.3),
    upper=0.0,
)
ELBOW = vkc.Cost("elbow", lambda s: (s.coordinate("elbow_joint") - 1.5) ** 2, weight=0.1)


def make_cup_scene(*obstacles: dict[str, Any]) -> vkc.Scene:
    """Return a hall with a cup on a table, and more obstacles."""
    table = describe_box("table", [0.6, 0.6, 0.02], [1.4, 0.0, 0.49])
    cup = {"name": "cup", "type": "cup", "position": [1.35, 0.0, 0.501]}
    return replace_scene_fields(make_hall(obstacles=[table, *obstacles]), objects=[cup])


@cache
def make_room() -> vkc.Scene:
    return make_cup_scene(
        describe_box("other", [0.6, 0.6, 0.02], [1.4, 1.2, 0.49]),
        describe_box("wall", [1.0, 0.05, 0.9], [1.5, 0.6, 0.45]),
    )


def plan_cup(*terms: vkc.Constraint | vkc.Cost, seed: int = 0) -> vkc.Plan:
    """Plan to place the cup on the other table."""
    return check_success(vkc.plan(make_room(), STEPS, options=SHORT, seed=seed, terms=terms))


plan_without_terms = cache(plan_cup)


def check_success(plan: vkc.Plan) -> vkc.Plan:
    assert plan.success, plan.summary()
    return plan


def compute_placements(
    plan: vkc.Plan, frame: str, times: np.ndarray | None = None
) -> list[pin.SE3]:
    world = World(plan.scene)
    data, index, found = world.model.createData(), world.model.getFrameId(frame), []
    for q in world.coordinates.q(world.compute_positions(plan.trajectory, times)):
        pin.forwardKinematics(world.model, data, q)
        found.append(pin.updateFramePlacement(world.model, data, index).copy())
    return found


def compute_min_cosine(plan: vkc.Plan) -> float:
    """Return the smallest cosine of the cup's tilt at 1000 times."""
    times = np.linspace(0.0, plan.trajectory.times[-1], 1000)
    return min(float(one.rotation[2, 2]) for one in compute_placements(plan, "cup.cup", times))


def compute_speeds(plan: vkc.Plan, frame: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the speed of a frame in every segment, and its position at the segment's end."""
    positions = np.array([placement.translation for placement in compute_placements(plan, frame)])
    speeds = np.linalg.norm(np.diff(positions, axis=0), axis=1) / np.diff(plan.trajectory.times)
    return speeds, positions[1:]


def test_speed_limit_near_a_point() -> None:
    plan = plan_cup(SLOW)

    def compute_excess(plan: vkc.Plan) -> float:
        speed, positions = compute_speeds(plan, "tool")
        return float((speed - 0.5 * (np.linalg.norm(positions - PERSON, axis=1) - 0.3)).max())

    assert compute_excess(plan_without_terms()) > 0.05
    assert compute_excess(plan) <= 1e-3
    assert plan.trajectory.times[-1] > plan_without_terms().trajectory.times[-1]


@pytest.mark.long
def test_cost_changes_the_posture() -> None:
    def compute_mean_cost(*terms: vkc.Cost) -> float:
        plans = [plan_cup(*terms, seed=seed) for seed in range(2)]
        elbows = [plan.trajectory.column("elbow_joint") for plan in plans]
        return float(np.mean([((elbow - 1.5) ** 2).mean() for elbow in elbows]))

    assert compute_mean_cost(ELBOW) < 0.7 * compute_mean_cost()


def test_constraint_on_a_link_of_a_fixed_object() -> None:
    """The constraint slows down the tray, not the hand. An inactive one prevents retiming, too."""
    steps = [vkc.Actuate("drawer", {"slide": 0.3}, "handle_free")]
    options = vkc.Options(reach_waypoints=16, move_waypoints=12)
    plans = []
    for limit in (0.03, 9.0):
        gently = vkc.Constraint(
            "gently", lambda s: ca.norm_2(s.velocity("drawer.tray")), upper=limit
        )
        found = vkc.plan(make_drawer_scene(), steps, options=options, terms=[gently])
        plans.append(check_success(found))
    slow, fast = (compute_speeds(plan, "drawer.tray")[0].max() for plan in plans)
    assert slow <= 0.031
    assert fast > 0.1
    assert compute_speeds(plans[0], "tool")[0].max() > 0.5
    motions = [plan.trajectory for plan in plans]
    slow, fast = (motion.times[motion.phases[0].last] for motion in motions)
    assert slow == pytest.approx(fast), "the hand reaches the handle as fast"


@pytest.mark.parametrize(
    "options",
    [
        {},
        pytest.param({"window": 2}, marks=pytest.mark.long),
        pytest.param({"simultaneous": False}, marks=pytest.mark.long),
    ],
)
def test_terms_hold_for_several_steps(options: dict[str, Any]) -> None:
    """`during` restricts each constraint to a phase of one step."""
    scene = make_cup_scene(describe_box("other", [0.6, 0.6, 0.02], [-0.5, 2.2, 0.79]))
    steps = [vkc.Place("cup", [-0.5, 2.1, 0.801]), vkc.GoTo(0.0, 0.0)]
    level = vkc.Constraint(
        "level",
        lambda s: s.rotation("cup.cup")[2, 2],
        lower=0.9995,
        during="place cup",
        tolerance=1e-5,
    )
    gently = vkc.Constraint(
        "gently", lambda s: ca.norm_2(s.velocity("base_link")), upper=0.2, during="go to"
    )
    plan = check_success(vkc.plan(scene, steps, options=SHORT, terms=[level, gently], **options))
    assert [term.name for term in plan.terms] == ["level", "gently"]
    assert compute_min_cosine(plan) >= 0.9995 - 1e-4
    (drive,) = (phase for phase in plan.trajectory.phases if phase.name == "go to")
    speed, _ = compute_speeds(plan, "base_link")
    assert speed[drive.first : drive.last].max() <= 0.201
    assert speed[: drive.first].max() > 0.21


def test_initial_guess_may_violate_a_constraint() -> None:
    over = vkc.Constraint(
        "elbow over", lambda s: s.coordinate("elbow_joint"), lower=1.0, during="place cup"
    )
    plan = plan_cup(over)
    placing = next(phase for phase in plan.trajectory.phases if phase.name == "place cup")
    elbow = plan.trajectory.column("elbow_joint")
    assert elbow[placing.first + 2 : placing.last + 1].min() >= 1.0 - 1e-3
    assert plan_without_terms().trajectory.column("elbow_joint").max() < 0.0


def test_constraint_can_represent_an_obstacle() -> None:
    """The initial guess passes through it."""
    middle = np.array([1.0, 0.02])
    around = vkc.Constraint(
        "around", lambda s: ca.sumsqr(s.position("base_link")[:2] - middle), lower=0.8**2
    )
    plan = check_success(vkc.plan(make_hall(), [vkc.GoTo(2.0, 0.0)], options=SHORT, terms=[around]))
    assert np.linalg.norm(plan.trajectory.positions[:, :2] - middle, axis=1).min() >= 0.799
    assert plan.trajectory.base_path_length() > 2.2


def test_infeasible_constraint_is_reported() -> None:
    never = vkc.Constraint("never", lambda s: s.position("tool")[2], lower=9.0)
    options = vkc.Options(reach_waypoints=5, max_restarts=1, max_outer=4)
    steps = [vkc.GoTo(0.5, 0.0)]
    plan = vkc.plan(make_hall(), steps, options=options, terms=[never], max_evaluations=2000)
    assert not plan.success
    assert "term never:" in plan.summary()
    violations = [one for one in plan.report.violations if one.constraint == "term"]
    (violation,) = (one for one in violations if "between" not in one.detail)
    assert violation.amount > 7.0


@pytest.mark.long
def test_plans_are_saved_with_their_terms(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = plan_cup(UPRIGHT)
    assert compute_min_cosine(plan) >= 0.97
    file = plan.save(tmp_path / "cup.npz")
    loaded = vkc.Plan.load(file)
    assert loaded.terms == plan.terms
    assert main(["check", str(file)]) == 0
    again = plan_cup(*loaded.terms)
    np.testing.assert_allclose(again.trajectory.positions, plan.trajectory.positions, atol=1e-6)
    with np.load(file, allow_pickle=False) as archive:
        data = dict(archive)
    about = json.loads(str(data["about"]))

    def save() -> str:
        np.savez(file, **{**data, "about": np.array(json.dumps(about))})
        return str(file)

    about["terms"][0] |= {"lower": 0.99999, "tolerance": 1e-6}
    capsys.readouterr()
    assert main(["check", save()]) == 1
    assert "term upright cup:" in capsys.readouterr().out
    about["terms"][0]["expression"]["code"][0][0] = "open"
    assert main(["check", save()]) == 2
    assert "not a saved term" in capsys.readouterr().err
    del about["terms"]  # a plan from before terms existed
    assert vkc.Plan.load(save()).terms == ()


def test_another_attachment_does_not_evade_a_constraint() -> None:
    """Phases are named after attachments: those of another one have other names."""
    scene = vkc.load_scene("door")
    reach = "reach door.handle"
    term = vkc.Constraint("far", lambda s: s.coordinate("base_x"), lower=4.9, during=reach)
    options: dict[str, Any] = {"options": SHORT, "initialization": "interpolated"}
    plan = vkc.plan(scene, [vkc.Actuate("door", {"hinge": 0.3})], terms=[term], **options)
    assert not plan.success
    assert any("which it lacks" in note for note in plan.report.notes), plan.summary()
