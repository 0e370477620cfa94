"""Tests planning of the base before the arm: successes, causes of failure, and attempts."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.drawers import (
    add_boxes,
    compute_handle_pose,
    compute_pose_error,
    load_drawer_scene,
    make_drawer_scene,
    make_grasping_scene,
    replace_scene_fields,
)
from helpers.judging import get_violation_names
from helpers.small_problems import load_door_scene

import vkc_pin as vkc
from vkc_pin.experiments.baselines import BASELINES, attempt, plan_separately, postures
from vkc_pin.experiments.baselines.attempt import FINER
from vkc_pin.experiments.household import TASKS
from vkc_pin.planning.plan import STAGES

ROOT = Path(__file__).resolve().parents[3]
PULL = vkc.Actuate("drawer", {"slide": 0.3})
OPTIONS = vkc.Options(reach_waypoints=20, move_waypoints=15)
DRIVE_AND_REACH = ["go to", "reach drawer.handle"]


@cache
def open_drawer(method: str) -> vkc.Plan:
    return plan_separately(load_drawer_scene(), [PULL], method=method, retries=1)


@cache
def open_door(method: str) -> vkc.Plan:
    return plan_separately(
        load_door_scene(), [vkc.Actuate("door", {"hinge": 0.3})], method=method, retries=1
    )


PLANS = {"drawer": open_drawer, "door": open_door}


def get_rows(plan: vkc.Plan, phase: int) -> np.ndarray:
    """Return the waypoints of a phase, the robot's columns."""
    span = plan.trajectory.phases[phase]
    return np.array(
        plan.trajectory.positions[span.first : span.last + 1, : plan.trajectory.robot_size]
    )


def limit_search(
    monkeypatch: pytest.MonkeyPatch, *, tries: int = 1000, base_poses: int = 1
) -> None:
    """Limit the search for solutions that do not exist."""
    monkeypatch.setattr(postures, "TRIES", tries)
    monkeypatch.setattr(attempt, "_HANDLE_POSES", base_poses)


def plan_failure(
    scene: vkc.Scene, status: str, phases: Sequence[str], **arguments: Any
) -> vkc.Plan:
    """Plan to pull the drawer; check the cause of the failure and the phases before it."""
    plan = plan_separately(scene, [PULL], **{"options": OPTIONS, "retries": 1, **arguments})
    assert (plan.success, plan.status, list_phase_names(plan)) == (False, status, [*phases])
    assert plan.report.violations
    assert f"FAILED, {status}" in plan.summary()
    return plan


def list_phase_names(plan: vkc.Plan) -> list[str]:
    return [phase.name for phase in plan.trajectory.phases]


@pytest.mark.parametrize("method", BASELINES)
@pytest.mark.parametrize(
    ("task", "name", "goal"), [("drawer", "drawer.slide", 0.3), ("door", "door.hinge", 0.3)]
)
def test_both_methods_succeed_in_open_space(task: str, name: str, goal: float, method: str) -> None:
    plan = PLANS[task](method)
    assert plan.success, plan.summary()
    assert plan.report.clearance > 0.0
    assert plan.trajectory.column(name)[-1] == pytest.approx(goal, abs=1e-3)
    assert plan.initialization == f"{method}, try 1"
    metrics = plan.metrics
    assert metrics["rounds"] == 1.0
    assert metrics["iterations"] > 0.0
    stage_times = sum(metrics[f"time_{stage}"] for stage in (*STAGES, "following"))
    assert 0.0 < stage_times <= metrics["planning_time"]


@pytest.mark.parametrize("method", BASELINES)
@pytest.mark.parametrize("task", PLANS)
def test_base_and_arm_move_one_after_the_other(task: str, method: str) -> None:
    plan = PLANS[task](method)
    drive, reach, *holds = plan.trajectory.phases
    assert (drive.name, dict(drive.held), dict(reach.held)) == ("go to", {}, {})
    assert reach.name == f"reach {task}.handle"
    assert [dict(phase.held) for phase in holds] == [{task: "handle"}] * len(holds)
    assert len(holds) == {"drawer": 1, "door": 2}[task]  # the door's knob is turned first
    driven, reached = get_rows(plan, 0), get_rows(plan, 1)
    assert np.ptp(driven[:, 3:], axis=0).max() == np.ptp(reached[:, :3], axis=0).max() == 0.0
    assert np.ptp(driven[:, 0]) > 0.3
    assert np.ptp(reached[:, 3:], axis=0).max() > 0.3
    if task == "door":
        assert np.ptp(get_rows(plan, 2)[:, :3], axis=0).max() < 1e-5, (
            "the base stands still while the latch is released"
        )
        assert np.ptp(plan.trajectory.column("door.knob")[holds[0].first : holds[0].last]) > 0.3
    # The object's joints move in finer steps, perhaps after the wait for the gripper.
    moved = holds[-1].last - holds[-1].first
    assert moved - FINER * plan.options.move_waypoints in (0, 1)


def test_differential_base_does_not_slip_sideways() -> None:
    scene = make_drawer_scene(base="differential")
    plan = plan_separately(scene, [PULL], options=OPTIONS)
    assert plan.success, plan.summary()
    x, y, yaw = plan.trajectory.positions[:, :3].T
    heading = (yaw[1:] + yaw[:-1]) / 2
    assert np.abs(np.cos(heading) * np.diff(y) - np.sin(heading) * np.diff(x)).max() < 1e-3


def compute_hash(plan: vkc.Plan) -> str:
    return hashlib.sha256(
        plan.trajectory.positions.tobytes() + plan.trajectory.times.tobytes()
    ).hexdigest()


@pytest.mark.long
def test_result_is_reproducible_in_another_process() -> None:
    code = (
        "import sys; sys.path[:0] = ['tests', 'tests/experiments/baselines']\n"
        "from test_separate import compute_hash, open_drawer\n"
        "print(*(compute_hash(open_drawer(method)) for method in ('B1', 'B2')))"
    )
    other = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
        timeout=240,
        env={**os.environ, "PYTHONHASHSEED": "7"},
    )
    assert other.stdout.split() == [compute_hash(open_drawer(method)) for method in BASELINES]


@pytest.mark.parametrize("method", BASELINES)
def test_narrow_aisle_has_no_base_pose(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    limit_search(monkeypatch)
    scene = add_boxes(load_drawer_scene(), counter_2=([0.9, 4.4, 1.2], [1.0, 0.0, 0.6]))
    plan = plan_failure(scene, "no base pose", ["stand"], method=method)
    assert np.ptp(plan.trajectory.positions, axis=0).max() == 0.0, "the robot stays at its start"
    assert get_violation_names(plan.report) == {("goal", "drawer.slide")}


def test_open_drawer_has_no_base_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    limit_search(monkeypatch)
    scene = add_boxes(make_drawer_scene(), post=([0.05, 0.05, 1.0], [1.65, 0.25, 0.5]))
    plan = plan_failure(scene, "no base pose", DRIVE_AND_REACH)
    last = plan.trajectory.positions[-1]
    assert compute_pose_error(plan.scene, last, compute_handle_pose()) < 1e-3
    # Only a grasp exempts the hand from its clearance to the tray.
    goal, *others = sorted(get_violation_names(plan.report), reverse=True)
    assert goal[0] == "goal"
    assert all(name == "clearance" and pair.endswith("drawer.tray") for name, pair in others)


def test_arm_does_not_reach_between_two_shelves(monkeypatch: pytest.MonkeyPatch) -> None:
    """The solver finds no path between two shelves."""
    limit_search(monkeypatch)
    shelves = {
        name: ([0.1, 0.8, 0.02], [1.6, 0.0, z]) for name, z in (("above", 0.905), ("below", 0.605))
    }
    options = dataclasses.replace(OPTIONS, max_restarts=1, max_iterations=20)
    scene = add_boxes(make_drawer_scene(), **shelves)
    phases = ["go to", *DRIVE_AND_REACH]
    plan = plan_failure(scene, "arm does not reach", phases, options=options)
    assert {"goal", "clearance"} & {v.constraint for v in plan.report.violations}


@pytest.mark.long
def test_failed_attempts_are_followed_by_others() -> None:
    scene = vkc.load_scene("household").with_start(base=[0.968827218, -0.761078307, 0.355251978])
    steps = TASKS["door"].steps
    plan = plan_separately(scene, steps, method="B1", seed=111)
    tries = int(plan.initialization.removeprefix("B1, try "))
    assert plan.success, plan.summary()
    assert tries > 1, "the first try sufficed: choose another start"
    assert plan.metrics["rounds"] == tries
    failed = plan_separately(scene, steps, method="B1", seed=111, retries=tries - 1)
    assert not failed.success


@pytest.mark.parametrize(
    ("stage", "phases"),
    [("solve", ["stand"]), ("follow", DRIVE_AND_REACH), ("find_base_poses", ["stand"])],
)
def test_ctrl_c_interrupts_each_stage(
    stage: str, phases: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    calls, original = [], getattr(attempt, stage)

    def press_ctrl_c(*arguments: Any, **keywords: Any) -> Any:
        calls.append(stage)
        signal.raise_signal(signal.SIGINT)
        return original(*arguments, **keywords)

    monkeypatch.setattr(attempt, stage, press_ctrl_c)
    plan_failure(make_drawer_scene(), "interrupted", phases, retries=3)
    assert calls == [stage]


@pytest.mark.parametrize(
    ("arguments", "field", "text"),
    [
        ({"scene": "drawer"}, "scene", "a Scene"),
        ({"method": "b2"}, "method", "did you mean 'B2'"),
        ({"retries": 0}, "retries", "at least 1"),
        ({"finer": 17}, "finer", "16"),
        ({"seed": -1}, "seed", "-1"),
        ({"time_limit": "5"}, "time_limit", "'5'"),
        ({"options": {"dt": 0.1}}, "options", "Options"),
        ({"steps": []}, "steps", "at least one step"),
        ({"steps": [PULL, vkc.Release()]}, "steps[1]", "expected Actuate, Place, GoTo or Reach"),
        ({"steps": [vkc.Actuate("drawr", {"slide": 0.3})]}, "steps[0].object", "'drawer'"),
    ],
    ids=str,
)
def test_invalid_arguments_are_refused(arguments: dict[str, Any], field: str, text: str) -> None:
    call: dict[str, Any] = {"scene": load_drawer_scene(), "steps": [PULL], **arguments}
    with pytest.raises(vkc.InputError) as caught:
        plan_separately(call.pop("scene"), call.pop("steps"), **call)
    assert caught.value.field == field
    assert text in str(caught.value)


@pytest.mark.parametrize("method", BASELINES)
def test_pose_is_reached(method: str) -> None:
    steps = [vkc.Reach((1.2, 0.4, 0.9, 0.0, 1.2, 0.3))]
    plan = plan_separately(load_drawer_scene(), steps, method=method, options=OPTIONS)
    assert plan.success, plan.summary()
    assert not plan.trajectory.phases[-1].held


def make_two_drawers() -> vkc.Scene:
    second = {"name": "second", "type": "drawer", "position": [1.93, -1.4, 0.0]}
    objects = [*load_drawer_scene().document["objects"], second]
    return replace_scene_fields(make_drawer_scene(), objects=objects)


MOVE = "move drawer.slide"


@pytest.mark.parametrize(
    ("make_scene", "other", "phases"),
    [
        (
            make_two_drawers,
            vkc.Actuate("second", {"slide": 0.2}),
            [*DRIVE_AND_REACH, MOVE, "go to", "reach second.handle", "move second.slide"],
        ),
        (make_drawer_scene, vkc.Actuate("drawer", {"slide": 0.15}), [*DRIVE_AND_REACH, MOVE, MOVE]),
        (lambda: make_grasping_scene(make_drawer_scene()), None, [MOVE]),
    ],
    ids=["two objects", "grasped by the first step", "grasped at the start"],
)
def test_object_is_reached_unless_it_is_grasped(
    make_scene: Callable[[], vkc.Scene], other: vkc.steps.Step | None, phases: list[str]
) -> None:
    steps = [PULL] if other is None else [PULL, other]
    plan = plan_separately(make_scene(), steps, options=OPTIONS)
    assert plan.success, plan.summary()
    assert list_phase_names(plan) == phases


def test_wall_blocks_the_base_path(monkeypatch: pytest.MonkeyPatch) -> None:
    limit_search(monkeypatch, base_poses=3)
    scene = add_boxes(make_drawer_scene(), wall=([0.1, 4.6, 2.4], [0.15, 0.0, 1.2]))
    plan_failure(scene, "no base path", ["go to"])


def test_time_limit_ends_planning(monkeypatch: pytest.MonkeyPatch) -> None:
    limit_search(monkeypatch, base_poses=4)
    plan = plan_failure(make_drawer_scene(), "time limit", ["stand"], time_limit=1e-6, retries=5)
    assert plan.metrics["rounds"] == 1.0


def test_evaluation_limit_is_reproducible() -> None:
    complete = open_drawer("B1")
    used = int(complete.metrics["evaluations"])
    assert compute_hash(
        plan_separately(load_drawer_scene(), [PULL], max_evaluations=used)
    ) == compute_hash(complete)
    limited = [
        plan_separately(load_drawer_scene(), [PULL], max_evaluations=2 * used // 3, planner=planner)
        for planner in (None, vkc.Planner())
    ]
    assert [plan.status for plan in limited] == ["evaluation limit"] * 2
    assert compute_hash(limited[0]) == compute_hash(limited[1])
