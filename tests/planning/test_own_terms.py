"""Motions planned with constraints and costs of the user's own; what changed is measured on the plain world model."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import box
from helpers.drawers import open_scene
from helpers.drives import hall

import vkc_pin as vkc
from vkc_pin.cli import main
from vkc_pin.world.task.terms import Term
from vkc_pin.world.trajectory.world_model import World

SHORT = vkc.Options(reach_waypoints=16)
OVER = [vkc.Place("cup", [1.35, 1.1, 0.501])]
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


@cache
def room() -> vkc.Scene:
    """A cup on one side of a wall, a table on the other."""
    obstacles = [
        box("table", [0.6, 0.6, 0.02], [1.4, 0.0, 0.49]),
        box("other", [0.6, 0.6, 0.02], [1.4, 1.2, 0.49]),
    ]
    scene = hall(obstacles=[*obstacles, box("wall", [1.0, 0.05, 0.9], [1.5, 0.6, 0.45])])
    return vkc.Scene.from_document(
        {
            **scene.document,
            "objects": [{"name": "cup", "type": "cup", "position": [1.35, 0.0, 0.501]}],
        }
    )


@cache
def plain(seed: int = 0) -> vkc.Plan:
    return checked(vkc.plan(room(), OVER, options=SHORT, seed=seed))


@cache
def upright(seed: int = 0) -> vkc.Plan:
    return checked(vkc.plan(room(), OVER, options=SHORT, seed=seed, terms=[UPRIGHT]))


def checked(plan: vkc.Plan) -> vkc.Plan:
    assert plan.success, plan.summary()
    return plan


def placements(plan: vkc.Plan, frame: str, times: np.ndarray | None = None) -> list[pin.SE3]:
    """Return where a frame is at the waypoints, or at some times, by numeric Pinocchio."""
    world = World(plan.scene)
    data, index, found = world.model.createData(), world.model.getFrameId(frame), []
    for q in world.coordinates.q(world.compute_positions(plan.trajectory, times)):
        pin.forwardKinematics(world.model, data, q)
        found.append(pin.updateFramePlacement(world.model, data, index).copy())
    return found


def steepest(plan: vkc.Plan) -> float:
    """Return the smallest cosine of the cup's tilt, looked at 1000 times."""
    times = np.linspace(0.0, plan.trajectory.times[-1], 1000)
    return min(float(placement.rotation[2, 2]) for placement in placements(plan, "cup.cup", times))


def speeds(plan: vkc.Plan, frame: str) -> tuple[np.ndarray, np.ndarray]:
    """Return how fast a frame is in every segment, and where it is at the end of it."""
    where = np.array([placement.translation for placement in placements(plan, frame)])
    return np.linalg.norm(np.diff(where, axis=0), axis=1) / np.diff(plan.trajectory.times), where[
        1:
    ]


@pytest.mark.long
def test_a_cup_stays_upright_that_otherwise_tilts() -> None:
    tilting = min((plain(seed) for seed in range(3)), key=steepest)
    assert steepest(tilting) < np.cos(np.radians(30.0))
    assert min(steepest(upright(seed)) for seed in range(3)) >= 0.98 - 0.01
    report = vkc.validate(room(), OVER, tilting.trajectory, SHORT, [UPRIGHT])
    worst = {violation.subject: violation for violation in report.violations}
    assert {violation.constraint for violation in report.violations} == {"term"}
    assert worst["upright cup"].amount == pytest.approx(0.98 - steepest(tilting), abs=5e-3)


def test_slowly_near_somebody() -> None:
    plan = checked(vkc.plan(room(), OVER, options=SHORT, terms=[SLOW]))

    def excess(plan: vkc.Plan) -> float:
        speed, where = speeds(plan, "tool")
        return float((speed - 0.5 * (np.linalg.norm(where - PERSON, axis=1) - 0.3)).max())

    assert excess(plain()) > 0.05
    assert excess(plan) <= 1e-3
    assert plan.trajectory.times[-1] > plain().trajectory.times[-1]


def test_a_cost_changes_the_posture() -> None:
    """On average over random seeds: which way an elbow bends is a seed's, and a cost moves it only from there."""

    def off(terms: list[vkc.Cost]) -> float:
        plans = [
            checked(vkc.plan(room(), OVER, options=SHORT, terms=terms, seed=seed))
            for seed in range(4)
        ]
        return float(
            np.mean([((plan.trajectory.column("elbow_joint") - 1.5) ** 2).mean() for plan in plans])
        )

    assert off([ELBOW]) < 0.6 * off([])


def test_a_cost_that_is_not_convex() -> None:
    wavy = vkc.Cost(
        "wavy",
        lambda s: (
            ca.cos(4 * s.coordinate("elbow_joint")) + ca.sin(3 * s.coordinate("wrist_3_joint"))
        ),
        weight=0.2,
    )
    goal = [vkc.GoTo(1.0, 0.5, 0.3)]
    plan = checked(vkc.plan(hall(), goal, options=SHORT, terms=[wavy]))
    usual = checked(vkc.plan(hall(), goal, options=SHORT))

    def sum_of(plan: vkc.Plan) -> float:
        elbow, wrist = (
            plan.trajectory.column(name)[1:] for name in ("elbow_joint", "wrist_3_joint")
        )
        return float((np.cos(4 * elbow) + np.sin(3 * wrist)).sum())

    assert sum_of(plan) < sum_of(usual) - 1.0


def test_a_link_of_an_object_that_stands_fixed() -> None:
    """The drawer's tray may only move slowly: that takes a longer time, and the hand is as fast as ever on its way there."""
    gently = vkc.Constraint("gently", lambda s: ca.norm_2(s.velocity("drawer.tray")), upper=0.03)
    steps, options = (
        [vkc.Actuate("drawer", {"slide": 0.3}, "handle_free")],
        vkc.Options(reach_waypoints=16, move_waypoints=12),
    )
    plan = checked(vkc.plan(open_scene(), steps, options=options, terms=[gently]))
    fast = vkc.Constraint(
        "fast", lambda s: ca.norm_2(s.velocity("drawer.tray")), upper=9.0
    )  # in the program's own time, too
    usual = checked(vkc.plan(open_scene(), steps, options=options, terms=[fast]))
    assert speeds(usual, "drawer.tray")[0].max() > 0.1
    assert speeds(plan, "drawer.tray")[0].max() <= 0.031
    assert speeds(plan, "tool")[0].max() > 0.5
    reached, usually = (
        trajectory.times[trajectory.phases[0].last]
        for trajectory in (plan.trajectory, usual.trajectory)
    )
    assert reached == pytest.approx(usually)


@pytest.mark.parametrize(
    "planner",
    [
        vkc.plan,
        functools.partial(vkc.plan, window=2),
        lambda *a, **k: vkc.plan(*a, simultaneous=False, **k),
    ],
)
def test_several_steps_keep_their_terms(planner: Callable[..., vkc.Plan]) -> None:
    """`during` names a phase of one step only, and is no mistake where the other is planned alone."""
    obstacles = [
        box("table", [0.6, 0.6, 0.02], [1.4, 0.0, 0.49]),
        box("other", [0.6, 0.6, 0.02], [-0.5, 2.2, 0.79]),
    ]
    document = {
        **hall(obstacles=obstacles).document,
        "objects": [{"name": "cup", "type": "cup", "position": [1.35, 0.0, 0.501]}],
    }
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
    plan = checked(
        planner(vkc.Scene.from_document(document), steps, options=SHORT, terms=[level, gently])
    )
    assert [term.name for term in plan.terms] == ["level", "gently"]
    assert steepest(plan) >= 0.9995 - 1e-4
    (going,) = (phase for phase in plan.trajectory.phases if phase.name == "go to")
    speed, _ = speeds(plan, "base_link")
    assert speed[going.first : going.last].max() <= 0.201
    assert speed[: going.first].max() > 0.21


def test_a_seed_may_be_far_from_a_constraint() -> None:
    """The elbow is at −2.2 rad where the cup is taken, in every seed that anybody would make, and must turn over on the way."""
    over = vkc.Constraint(
        "elbow over", lambda s: s.coordinate("elbow_joint"), lower=1.0, during="place cup"
    )
    plan = checked(vkc.plan(room(), OVER, options=SHORT, terms=[over]))
    placing = next(phase for phase in plan.trajectory.phases if phase.name == "place cup")
    assert (
        plan.trajectory.column("elbow_joint")[placing.first + 2 : placing.last + 1].min()
        >= 1.0 - 1e-3
    )
    assert plain().trajectory.column("elbow_joint").max() < 0.0
    # A wall that nobody else knows of: only the program keeps the base away, from a seed that goes
    # right through.
    middle = np.array([1.0, 0.02])
    around = vkc.Constraint(
        "around", lambda s: ca.sumsqr(s.position("base_link")[:2] - middle), lower=0.8**2
    )
    plan = checked(vkc.plan(hall(), [vkc.GoTo(2.0, 0.0)], options=SHORT, terms=[around]))
    assert np.linalg.norm(plan.trajectory.positions[:, :2] - middle, axis=1).min() >= 0.799
    assert plan.trajectory.base_path_length() > 2.2


def test_what_cannot_be_kept_is_reported() -> None:
    never = vkc.Constraint("never", lambda s: s.position("tool")[2], lower=9.0)
    plan = vkc.plan(
        hall(),
        [vkc.GoTo(0.5, 0.0)],
        options=vkc.Options(reach_waypoints=5, max_restarts=1, max_outer=4),
        terms=[never],
    )
    assert not plan.success
    assert "term never:" in plan.summary()
    (violation,) = [
        v for v in plan.report.violations if v.constraint == "term" and "between" not in v.detail
    ]
    assert violation.amount > 7.0


@pytest.mark.long
def test_plans_are_saved_with_their_terms(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = upright().save(tmp_path / "cup.npz")
    loaded = vkc.Plan.load(file)
    assert loaded.terms == upright().terms
    assert vkc.validate(
        loaded.scene, loaded.steps, loaded.trajectory, loaded.options, loaded.terms
    ).ok
    assert main(["check", str(file)]) == 0
    again = checked(
        vkc.plan(loaded.scene, loaded.steps, options=loaded.options, terms=loaded.terms)
    )
    np.testing.assert_allclose(
        again.trajectory.positions, upright().trajectory.positions, atol=1e-6
    )
    assert plain().terms == ()
    with np.load(file, allow_pickle=False) as archive:
        data = {name: archive[name] for name in archive.files}
    about = json.loads(str(data["about"]))
    about["terms"][0] |= {"lower": 0.99999, "tolerance": 1e-6}
    np.savez(file, **{**data, "about": np.array(json.dumps(about))})
    capsys.readouterr()
    assert main(["check", str(file)]) == 1
    assert "term upright cup:" in capsys.readouterr().out
    about["terms"][0]["expression"]["code"][0][0] = "open"
    np.savez(file, **{**data, "about": np.array(json.dumps(about))})
    assert main(["check", str(file)]) == 2
    assert "not a saved term" in capsys.readouterr().err
    del about["terms"]  # a plan of before there were any
    np.savez(file, **{**data, "about": np.array(json.dumps(about))})
    assert vkc.Plan.load(file).terms == ()


def test_without_terms_nothing_changes() -> None:
    def motion(**terms: Sequence[Term]) -> Any:
        return vkc.plan(room(), OVER, options=SHORT, **terms).trajectory.positions

    np.testing.assert_array_equal(motion(), motion(terms=[]))
