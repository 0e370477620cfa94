"""Base and arm planned one after the other: where both methods must succeed, where they must fail and why, and the tries."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import signal
import subprocess
import sys
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.drawers import changed, drawer_scene, handle, holding, off, open_scene, with_boxes
from helpers.small_problems import door_scene

import vkc_pin as vkc
from vkc_pin.baselines import BASELINES, attempt, plan_separately, separate
from vkc_pin.baselines import postures as poses
from vkc_pin.baselines.attempt import FINER
from vkc_pin.baselines.following import Followed, follow
from vkc_pin.baselines.paths import BasePaths
from vkc_pin.benchmarks.household import TASKS
from vkc_pin.planning.solver.to_trajectory import make_trajectory
from vkc_pin.planning.statistics import STAGES

ROOT = Path(__file__).resolve().parents[2]
PULL = vkc.Actuate("drawer", {"slide": 0.3})
OPTIONS = vkc.Options(reach_waypoints=20, move_waypoints=15)


@cache
def open_drawer(method: str) -> vkc.Plan:
    return plan_separately(drawer_scene(), [PULL], method=method, retries=1)


@cache
def open_door(method: str) -> vkc.Plan:
    return plan_separately(
        door_scene(), [vkc.Actuate("door", {"hinge": 0.3})], method=method, retries=1
    )


PLANS = {"drawer": open_drawer, "door": open_door}


def rows(plan: vkc.Plan, phase: int) -> np.ndarray:
    """Return the waypoints of a phase, the robot's columns, without the wait for the hand at its beginning."""
    span = plan.trajectory.phases[phase]
    return np.array(
        plan.trajectory.positions[span.first : span.last + 1, : plan.trajectory.robot_size]
    )


def limited(monkeypatch: pytest.MonkeyPatch, *, tries: int = 1000, stands: int = 1) -> None:
    """Look less far than usual for what is not there."""
    monkeypatch.setattr(poses, "TRIES", tries)
    monkeypatch.setattr(attempt, "_STANDS", stands)


def failed(scene: vkc.Scene, **arguments: Any) -> vkc.Plan:
    plan = plan_separately(scene, [PULL], **{"options": OPTIONS, "retries": 1, **arguments})
    assert not plan.success
    assert plan.report.violations
    assert f"FAILED, {plan.status}" in plan.summary()
    return plan


# --- where they must succeed
# -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", BASELINES)
@pytest.mark.parametrize("task", PLANS)
def test_in_open_space(task: str, method: str) -> None:
    plan = PLANS[task](method)
    assert plan.success, plan.summary()
    assert plan.status == "success"
    again = vkc.validate(plan.scene, plan.steps, plan.trajectory, plan.options)
    assert again.ok, again.lines()
    assert again.clearance == plan.report.clearance > 0.0
    np.testing.assert_allclose(plan.trajectory.positions[0, :9], plan.scene.start, atol=1e-9)
    name, goal = {"drawer": ("drawer.slide", 0.3), "door": ("door.hinge", 0.3)}[task]
    assert plan.trajectory.column(name)[-1] == pytest.approx(goal, abs=1e-3)
    assert plan.initialization == f"{method}, try 1"


@pytest.mark.parametrize("method", BASELINES)
@pytest.mark.parametrize("task", PLANS)
def test_path_lengths_are_those_of_the_trajectory(task: str, method: str) -> None:
    plan = PLANS[task](method)
    m, motion = plan.metrics, plan.trajectory
    change = np.diff(motion(np.linspace(motion.times[0], motion.times[-1], 50_001)), axis=0)
    assert m["base_path_length"] == pytest.approx(
        sum(np.hypot(x, y) for x, y in change[:, :2]), rel=1e-3
    )
    assert m["base_path_length_l1"] == pytest.approx(
        np.abs(change[:, 0]).sum() + np.abs(change[:, 1]).sum(), rel=1e-3
    )
    assert m["arm_path_length"] == pytest.approx(np.abs(change[:, 3:9]).sum(), rel=1e-3)
    assert m["duration"] == plan.trajectory.times[-1]
    assert m["clearance"] == plan.report.clearance
    assert m["closure_error"] == plan.report.closure_error
    assert m["rounds"] == 1.0
    assert m["iterations"] > 0.0
    parts = sum(m[f"time_{part}"] for part in (*STAGES, "following"))
    assert 0.0 < parts <= m["planning_time"]
    assert m["build_time"] >= 0.0


@pytest.mark.parametrize("method", BASELINES)
@pytest.mark.parametrize("task", PLANS)
def test_base_and_arm_move_one_after_the_other(task: str, method: str) -> None:
    plan = PLANS[task](method)
    drive, reach, *holds = plan.trajectory.phases
    assert (drive.name, dict(drive.held), dict(reach.held)) == ("go to", {}, {})
    assert reach.name == f"reach {task}.handle"
    assert [dict(phase.held) for phase in holds] == [{task: "handle"}] * len(holds)
    assert len(holds) == {"drawer": 1, "door": 2}[task]  # the door's knob is turned before
    np.testing.assert_array_equal(
        rows(plan, 0)[:, 3:], np.tile(plan.scene.start[3:], (len(rows(plan, 0)), 1))
    )
    np.testing.assert_array_equal(
        rows(plan, 1)[:, :3], np.tile(rows(plan, 0)[-1, :3], (len(rows(plan, 1)), 1))
    )
    assert np.ptp(rows(plan, 0)[:, 0]) > 0.3
    assert np.ptp(rows(plan, 1)[:, 3:], axis=0).max() > 0.3
    if task == "door":
        assert np.ptp(rows(plan, 2)[:, :3], axis=0).max() < 1e-5, (
            "it stands while the latch is released"
        )
        assert np.ptp(plan.trajectory.column("door.knob")[holds[0].first : holds[0].last]) > 0.3
    # The object's joints run to their goals in finer steps.
    moved = holds[-1].last - holds[-1].first
    assert moved in (
        FINER * plan.options.move_waypoints,
        FINER * plan.options.move_waypoints + 1,
    )  # and the hand's wait


def test_b1_moves_the_drawer_by_its_time_law_and_the_hand_stays_on_the_bar() -> None:
    plan = open_drawer("B1")
    span = plan.trajectory.phases[-1]
    slide = plan.trajectory.column("drawer.slide")[span.first : span.last + 1]
    share = np.linspace(0.0, 1.0, FINER * plan.options.move_waypoints + 1)
    np.testing.assert_allclose(slide[-len(share) :], 0.3 * (3 * share**2 - 2 * share**3), atol=2e-6)
    for row in plan.trajectory.positions[span.first : span.last + 1 : 7]:
        assert off(plan.scene, row, handle(row[plan.trajectory.names.index("drawer.slide")])) < 1e-3


def test_a_differential_base() -> None:
    scene = open_scene(base="differential")
    plan = plan_separately(scene, [PULL], options=OPTIONS)
    assert plan.success, plan.summary()
    x, y, yaw = plan.trajectory.positions[:, :3].T
    heading = (yaw[1:] + yaw[:-1]) / 2
    assert np.abs(np.cos(heading) * np.diff(y) - np.sin(heading) * np.diff(x)).max() < 1e-3


def digest(plan: vkc.Plan) -> str:
    return hashlib.sha256(
        plan.trajectory.positions.tobytes() + plan.trajectory.times.tobytes()
    ).hexdigest()


@pytest.mark.parametrize("method", BASELINES)
def test_the_same_seed_gives_the_same_motion(method: str) -> None:
    again = plan_separately(drawer_scene(), [PULL], method=method, retries=1)
    np.testing.assert_array_equal(
        again.trajectory.positions, open_drawer(method).trajectory.positions
    )


def test_the_same_seed_gives_the_same_motion_in_two_processes() -> None:
    code = (
        "import hashlib, vkc_pin as vkc\n"
        "from vkc_pin.baselines import plan_separately\n"
        "for method in ('B1', 'B2'):\n"
        "    t = plan_separately(vkc.load_scene('drawer'), [vkc.Actuate('drawer', {'slide': 0.3})], method=method).trajectory\n"
        "    print(hashlib.sha256(t.positions.tobytes() + t.times.tobytes()).hexdigest())"
    )
    outputs = set()
    for hash_seed in ("7", "8"):
        environment = {**os.environ, "PYTHONHASHSEED": hash_seed}
        other = subprocess.run(
            [sys.executable, "-c", code],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
            timeout=120,
            env=environment,
        )
        outputs.add(tuple(other.stdout.split()[-2:]))
    assert len(outputs) == 1


# --- where they must fail
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", BASELINES)
def test_an_aisle_too_narrow_to_stand_in(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """No base fits before the drawer, and over the counters the arm is too short."""
    limited(monkeypatch)
    plan = failed(
        with_boxes(drawer_scene(), counter_2=([0.9, 4.4, 1.2], [1.0, 0.0, 0.6])), method=method
    )
    assert plan.status == "no base pose"
    assert [phase.name for phase in plan.trajectory.phases] == ["stand"]
    assert np.ptp(plan.trajectory.positions, axis=0).max() == 0.0, "it stands at its start"
    assert [(v.constraint, v.subject) for v in plan.report.violations] == [("goal", "drawer.slide")]


@pytest.mark.parametrize("method", BASELINES)
def test_the_same_failure_every_time(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    limited(monkeypatch)
    scene = with_boxes(drawer_scene(), board=([0.02, 1.0, 1.2], [1.7, 0.0, 0.6]))
    first, second = (failed(scene, method=method, retries=2) for _ in range(2))
    assert (
        (first.status, first.metrics["rounds"])
        == (second.status, second.metrics["rounds"])
        == ("no base pose", 2.0)
    )
    np.testing.assert_array_equal(first.trajectory.positions, second.trajectory.positions)


def test_no_room_for_the_drawer_when_it_is_open(monkeypatch: pytest.MonkeyPatch) -> None:
    """The hand gets to the handle; but at the end the drawer would stand in a post beside it."""
    limited(monkeypatch)
    plan = failed(with_boxes(open_scene(), post=([0.05, 0.05, 1.0], [1.65, 0.25, 0.5])))
    assert plan.status == "no base pose"
    assert [phase.name for phase in plan.trajectory.phases] == ["go to", "reach drawer.handle"]
    last = plan.trajectory.positions[-1]
    assert off(plan.scene, last, handle()) < 1e-3
    kinds = {v.constraint for v in plan.report.violations}
    assert "goal" in kinds
    # A motion that ends before the grasp has no leave to be as close to the tray as a grasp is.
    assert all(
        v.subject.endswith("drawer.tray")
        for v in plan.report.violations
        if v.constraint == "clearance"
    )
    assert kinds <= {"goal", "clearance"}


def test_the_arm_does_not_reach(monkeypatch: pytest.MonkeyPatch) -> None:
    """The handle is behind two shelves: there are configurations, but the solver finds no way to them."""
    limited(monkeypatch)
    shelves = {
        name: ([0.1, 0.8, 0.02], [1.6, 0.0, 0.755 + z])
        for name, z in (("above", 0.15), ("below", -0.15))
    }
    options = dataclasses.replace(OPTIONS, max_restarts=1, max_iterations=20)
    plan = failed(with_boxes(open_scene(), **shelves), options=options)
    assert plan.status == "arm does not reach"
    assert [phase.name for phase in plan.trajectory.phases][-2:] == ["go to", "reach drawer.handle"]
    assert {"goal", "clearance"} & {v.constraint for v in plan.report.violations}


def test_no_way_for_the_base_while_the_drawer_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(BasePaths, "path", lambda *_: None)
    plan = failed(open_scene())
    assert plan.status == "no base path"
    assert [phase.name for phase in plan.trajectory.phases] == ["go to", "reach drawer.handle"]


@pytest.mark.parametrize(
    ("spoil", "cause"),
    [
        ((3, lambda share: 2.0 * (share == 0.5)), "too fast"),  # the shoulder jumps
        ((8, lambda share: 0.3 * share), "closure"),  # the hand turns on the bar
    ],
    ids=["too fast", "closure"],
)
def test_how_it_follows_is_checked(
    spoil: tuple[int, Any], cause: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def spoilt(*arguments: Any, **keywords: Any) -> Followed:
        found = follow(*arguments, **keywords)
        found.z[:, spoil[0]] += spoil[1](np.arange(1, len(found.z) + 1) / len(found.z))
        return found

    monkeypatch.setattr(attempt, "follow", spoilt)
    monkeypatch.setattr(attempt, "_ENDS", 2)
    plan = failed(open_scene())
    assert plan.status == cause
    assert plan.trajectory.phases[-1].name == "move drawer.slide", (
        "what there is of it can be looked at"
    )
    wanted = {"too fast": {"velocity", "acceleration"}, "closure": {"slide", "closure"}}[cause]
    assert wanted & {v.constraint for v in plan.report.violations}


def test_of_several_ends_the_one_that_came_furthest_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = iter(
        [("collision", 0.4), ("no inverse kinematics", 0.7), ("collision", 0.7), ("", 1.0)]
    )
    seen = []

    def spoilt(*arguments: Any, **keywords: Any) -> Followed:
        cause, share = next(answers)
        found = follow(*arguments, **keywords)
        found.z[round(share * len(found.z)) :] = found.z[round(share * len(found.z))]
        seen.append(found.z[-1, :3])
        return dataclasses.replace(found, cause=cause, share=share)

    monkeypatch.setattr(attempt, "follow", spoilt)
    monkeypatch.setattr(attempt, "_ENDS", 3)
    plan = failed(open_scene())
    assert plan.status == "no inverse kinematics"
    np.testing.assert_allclose(plan.trajectory.positions[-1, :3], seen[1], atol=1e-9)
    assert np.ptp(seen, axis=0).max() > 0.05, "each goes to another place"


def test_where_the_arm_does_not_reach_the_next_place_is_tried(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """From where all began; the same place again here, at which it does."""
    reach, free = attempt.Attempt._reach, attempt.Attempt._free
    bases: list[np.ndarray] = []

    def second_time(self: attempt.Attempt, steps: Any, pose: np.ndarray) -> None:
        bases.append(self.scene.start[:3])
        if len(bases) < 2:
            raise attempt.FailedError("arm does not reach")
        reach(self, steps, pose)

    monkeypatch.setattr(attempt.Attempt, "_reach", second_time)
    monkeypatch.setattr(attempt.Attempt, "_free", lambda self, poses: free(self, poses)[[0, 0]])
    plan = plan_separately(open_scene(), [PULL], options=OPTIONS, retries=1)
    assert plan.success, plan.summary()
    assert [phase.name for phase in plan.trajectory.phases] == [
        "go to",
        "reach drawer.handle",
        "move drawer.slide",
    ]
    assert len(bases) == 2
    np.testing.assert_allclose(rows(plan, 0)[-1, :3], bases[1], atol=1e-9)


@pytest.mark.parametrize(
    ("drives", "reaches", "status", "phases"),
    [
        ("fff", "", "no base path", 1),
        ("ddd", "fff", "arm does not reach", 2),
        ("fdf", "f", "arm does not reach", 2),
        ("dff", "f", "arm does not reach", 2),
    ],
)
def test_of_several_places_the_one_that_came_furthest_counts(
    drives: str, reaches: str, status: str, phases: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """d: it is done, f: it fails, and what there is of it is shown, after what was done before."""
    drive, reach = iter(drives), iter(reaches)

    def done(self: attempt.Attempt, steps: Any, cause: str, works: bool) -> None:
        problem = self._problem(steps)
        z = (
            problem.start
            + np.arange(1, problem.segments + 1)[:, None] * np.eye(problem.chain.size)[0] * 1e-3
        )
        dt = problem.timing_for(z).dt
        if not works:
            raise attempt.FailedError(cause, make_trajectory(problem, z, dt))
        self._take(problem, z, dt)

    def driven(self: attempt.Attempt, pose: np.ndarray) -> None:
        done(self, [vkc.GoTo(0.0, 0.0)], "no base path", next(drive) == "d")

    def reached(self: attempt.Attempt, steps: Any, pose: np.ndarray) -> None:
        done(self, steps, "arm does not reach", next(reach) == "d")

    every = attempt.postures
    monkeypatch.setattr(
        attempt, "postures", lambda problem: list(every(problem))[:1]
    )  # the arm as it is
    monkeypatch.setattr(attempt, "_STANDS", 3)
    monkeypatch.setattr(attempt.Attempt, "_drive", driven)
    monkeypatch.setattr(attempt.Attempt, "_reach", reached)
    plan = failed(open_scene())
    assert plan.status == status
    assert [phase.name for phase in plan.trajectory.phases] == ["go to", "reach drawer.handle"][
        :phases
    ]
    np.testing.assert_allclose(plan.trajectory.positions[0, :9], plan.scene.start, atol=1e-12)


# --- tries, time and Ctrl-C
# --------------------------------------------------------------------------------------------


class Tries:
    """Stands for `Attempt`: what the tries lead to is written down beforehand."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *answers: tuple[str, float]) -> None:
        self.answers, self.seeds = iter(answers), list[list[int]]()
        self.trajectory = open_drawer("B1").trajectory
        monkeypatch.setattr(separate, "Attempt", self)
        monkeypatch.setattr(separate, "validate", self.validate)
        self.status = ""

    def __call__(self, scene: vkc.Scene, options: vkc.Options, **keywords: Any) -> Any:
        self.seeds.append(list(keywords["seed"]))
        times = dict.fromkeys([*STAGES, "following"], 1.0)
        return SimpleNamespace(run=self.run, times=times, build_time=0.0, iterations=10)

    def run(self, steps: Any) -> tuple[vkc.Trajectory, float, str]:
        self.status, came = next(self.answers)
        # Which try it comes from can be seen at the first waypoint.
        positions = np.array(self.trajectory.positions)
        positions[0, 0] = len(self.seeds)
        return (
            dataclasses.replace(self.trajectory, positions=positions, curve=None),
            came,
            self.status,
        )

    def validate(self, *_: Any) -> vkc.Report:
        wrong = vkc.Violation(
            "goal", "drawer.slide", waypoint=0, time=0.0, amount=1.0, unit="m", detail=""
        )
        return vkc.Report(() if self.status == "fine" else (wrong,))


@pytest.mark.parametrize(
    ("answers", "taken", "status"),
    [
        ([("fine", np.inf), ("fine", np.inf)], 1, "success"),
        ([("collision", 2.4), ("", np.inf), ("fine", np.inf)], 3, "success"),
        (
            [("collision", 2.4), ("no base path", 1.0), ("too fast", 2.5), ("collision", 2.5)],
            3,
            "too fast",
        ),
        ([("", np.inf), ("collision", 2.9), ("", np.inf), ("no base pose", 0.0)], 1, "rejected"),
        ([("no base pose", 0.0)] * 4, 1, "no base pose"),
    ],
)
@pytest.mark.made_up
def test_tries(
    answers: list[tuple[str, float]], taken: int, status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Up to the first that validation accepts; of failures, the one that came furthest."""
    tries = Tries(monkeypatch, *answers)
    plan = plan_separately(drawer_scene(), [PULL], method="B2", seed=3, retries=4)
    last = taken if status == "success" else 4
    assert tries.seeds == [[3, number] for number in range(last)], "each with other random numbers"
    assert (plan.status, plan.success) == (status, status == "success")
    assert plan.trajectory.positions[0, 0] == taken
    assert plan.initialization == f"B2, try {taken}"
    assert plan.metrics["rounds"] == last
    assert plan.metrics["iterations"] == 10.0 * last, "of all tries"
    assert plan.metrics["time_following"] == last


def test_a_real_try_that_fails_is_followed_by_one_with_other_random_numbers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nothing is replaced here: what the tries lead to, and what validation says of them, is written down on the way."""
    seeds, ends = list[list[int]](), list[tuple[vkc.Trajectory, float, str]]()

    class Noted(attempt.Attempt):
        def __init__(self, *arguments: Any, **named: Any) -> None:
            seeds.append(list(named["seed"]))
            super().__init__(*arguments, **named)

        def run(self, steps: Any) -> tuple[vkc.Trajectory, float, str]:
            ends.append(super().run(steps))
            return ends[-1]

    monkeypatch.setattr(separate, "Attempt", Noted)
    scene = vkc.load_scene("household").with_start(base=[0.968827218, -0.761078307, 0.355251978])
    task = TASKS["door"]
    plan = plan_separately(scene, task.steps, method="B1", seed=111)
    tries = int(plan.initialization.removeprefix("B1, try "))
    assert plan.success, plan.summary()
    assert seeds == [[111, number] for number in range(tries)]
    assert tries > 1, "the first try sufficed: choose another start"
    assert plan.metrics["rounds"] == len(ends) == tries
    assert [cause for _, _, cause in ends][-1] == ""
    for motion, _, cause in ends[:-1]:
        assert cause or not vkc.validate(scene, task.steps, motion, plan.options).ok
    assert vkc.validate(scene, task.steps, plan.trajectory, plan.options).ok


def test_after_the_time_limit_there_is_no_other_try(monkeypatch: pytest.MonkeyPatch) -> None:
    tries = Tries(monkeypatch, *[("collision", 2.4)] * 4)
    plan = plan_separately(drawer_scene(), [PULL], retries=4, time_limit=1e-9)
    assert len(tries.seeds) == 1
    assert plan.status == "time limit", "not all tries were made"
    assert plan.report.notes == ("the try that came furthest failed with: collision",)


def test_a_time_limit_that_is_not_reached_changes_nothing() -> None:
    plan = plan_separately(drawer_scene(), [PULL], retries=1, time_limit=60.0)
    assert plan.success
    assert digest(plan) == digest(open_drawer("B1"))


@pytest.mark.parametrize("stage", ["solve", "follow", "base_poses"])
def test_ctrl_c_ends_it(stage: str, monkeypatch: pytest.MonkeyPatch) -> None:
    calls, done = [], getattr(attempt, stage)

    def pressed(*arguments: Any, **given: Any) -> Any:
        calls.append(stage)
        signal.raise_signal(signal.SIGINT)
        return done(*arguments, **given)

    monkeypatch.setattr(attempt, stage, pressed)
    plan = failed(open_scene(), retries=3)
    assert plan.status == "interrupted"
    assert calls == [stage]
    before = {
        "solve": ["stand"],
        "base_poses": ["stand"],
        "follow": ["go to", "reach drawer.handle"],
    }[stage]
    assert [phase.name for phase in plan.trajectory.phases] == before


# --- misuse
# ------------------------------------------------------------------------------------------------------------


MISUSES: dict[str, tuple[dict[str, Any], str, str]] = {
    "unknown method": ({"method": "B3"}, "method", "B1"),
    "method in small letters": ({"method": "b2"}, "method", "did you mean 'B2'"),
    "no tries": ({"retries": 0}, "retries", "at least 1"),
    "half a try": ({"retries": 1.5}, "retries", "1.5"),
    "another step": (
        {"steps": [PULL, vkc.Release()]},
        "steps[1]",
        "expected Actuate, Place, GoTo or Reach",
    ),
    "a grasp": (
        {"steps": [vkc.Grasp("drawer")]},
        "steps[0]",
        "expected Actuate, Place, GoTo or Reach",
    ),
    "no steps": ({"steps": []}, "steps", "at least one step"),
    "one step alone": ({"steps": PULL}, "steps", "a list of steps"),
    "unknown object": (
        {"steps": [vkc.Actuate("drawr", {"slide": 0.3})]},
        "steps[0].object",
        "did you mean 'drawer'",
    ),
    "unknown joint": (
        {"steps": [PULL, vkc.Actuate("drawer", {"slid": 0.1})]},
        "steps[1].joints",
        "did you mean 'slide'",
    ),
    "unknown attachment": (
        {"steps": [vkc.Actuate("drawer", {"slide": 0.3}, "handel")]},
        "steps[0].attachment",
        "did you mean 'handle'",
    ),
}


@pytest.mark.parametrize("case", MISUSES.values(), ids=MISUSES)
def test_misuse_raises(case: tuple[dict[str, Any], str, str]) -> None:
    arguments, field, text = case
    call: dict[str, Any] = {"steps": [PULL], **arguments}
    with pytest.raises(vkc.InputError) as caught:
        plan_separately(drawer_scene(), call.pop("steps"), **call)
    assert caught.value.field == field
    assert text in str(caught.value)


@pytest.mark.parametrize("method", ["B1", "B2"])
def test_a_tool_is_brought_to_a_pose(method: str) -> None:
    steps = [vkc.Reach((1.2, 0.4, 0.9, 0.0, 1.2, 0.3))]
    plan = plan_separately(drawer_scene(), steps, method=method, options=OPTIONS)
    assert plan.success
    assert vkc.validate(plan.scene, steps, plan.trajectory, OPTIONS).ok
    assert not plan.trajectory.phases[-1].held


def test_one_thing_after_another() -> None:
    second = {"name": "second", "type": "drawer", "position": [1.93, -1.4, 0.0]}
    scene = changed(open_scene(), objects=[*drawer_scene().document["objects"], second])
    plan = plan_separately(scene, [PULL, vkc.Actuate("second", {"slide": 0.2})], options=OPTIONS)
    assert plan.success, plan.summary()
    names = [phase.name for phase in plan.trajectory.phases]
    first = ["go to", "reach drawer.handle", "move drawer.slide"]
    assert names == [*first, "go to", "reach second.handle", "move second.slide"]


def test_the_same_thing_twice() -> None:
    """It is in the hand already."""
    plan = plan_separately(
        open_scene(), [vkc.Actuate("drawer", {"slide": 0.15}), PULL], options=OPTIONS
    )
    assert plan.success, plan.summary()
    names = [phase.name for phase in plan.trajectory.phases]
    assert names == ["go to", "reach drawer.handle", "move drawer.slide", "move drawer.slide"]


def test_what_is_taken_is_what_moves_the_joints(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first attachment of a refrigerator with two leaves moves the left one."""
    thing = vkc.load_object(vkc.procedural.random_object("refrigerator", 0))
    placed = vkc.PlacedObject("it", thing, pin.SE3.Identity(), np.zeros(2))
    scene = dataclasses.replace(door_scene(), objects={"it": placed})
    taken: list[Any] = []
    one = attempt.Attempt(scene, vkc.Options(), refine=False, seed=[0, 0])
    monkeypatch.setattr(one, "_take_hold", taken.extend)
    monkeypatch.setattr(one, "_move", taken.append)
    step = vkc.Actuate("it", {"hinge_right": 0.5})
    one._actuate(step)
    assert taken == [vkc.Grasp("it", "handle_right"), step]


def test_what_is_held_at_the_start() -> None:
    plan = plan_separately(holding(open_scene()), [PULL], options=OPTIONS)
    assert plan.success, plan.summary()
    assert [phase.name for phase in plan.trajectory.phases] == ["move drawer.slide"]


def test_walled_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """There are places at the handle, but no way to them."""
    limited(monkeypatch, stands=3)
    plan = failed(with_boxes(open_scene(), wall=([0.1, 4.6, 2.4], [0.15, 0.0, 1.2])))
    assert plan.status == "no base path"
    assert [phase.name for phase in plan.trajectory.phases] == ["go to"]


def test_a_time_limit_ends_planning_inside_a_try(monkeypatch: pytest.MonkeyPatch) -> None:
    limited(monkeypatch, stands=4)
    plan = failed(open_scene(), time_limit=1e-6, retries=5)
    assert plan.status == "time limit"
    assert plan.metrics["rounds"] == 1.0


def test_max_evaluations_ends_planning_at_the_same_place() -> None:
    whole = open_drawer("B1")
    used = int(whole.metrics["evaluations"])
    assert digest(plan_separately(drawer_scene(), [PULL], max_evaluations=used)) == digest(whole)
    short = [
        plan_separately(drawer_scene(), [PULL], max_evaluations=2 * used // 3, planner=planner)
        for planner in (None, vkc.Planner())
    ]
    assert [plan.status for plan in short] == ["evaluation limit"] * 2
    assert digest(short[0]) == digest(short[1])


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ({"seed": -1}, "seed"),
        ({"seed": 0.5}, "seed"),
        ({"time_limit": "5"}, "time_limit"),
        ({"time_limit": -1.0}, "time_limit"),
        ({"time_limit": float("nan")}, "time_limit"),
        ({"options": {"dt": 0.1}}, "options"),
        ({"scene": "drawer"}, "scene"),
        ({"retries": True}, "retries"),
    ],
    ids=str,
)
def test_arguments_are_checked_as_those_of_plan(arguments: dict[str, Any], field: str) -> None:
    call = {"scene": drawer_scene(), **arguments}
    with pytest.raises(vkc.InputError) as caught:
        plan_separately(call.pop("scene"), [PULL], **{"retries": 1, **call})
    assert caught.value.field == field
