"""Tests the experiment that executes plans while the world differs from them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.experiments import run_experiment
from oracle.executed import judge_motion

import vkc_pin as vkc
from vkc_pin.experiments.closed_loop import ROWS, _disturb, _Localisation
from vkc_pin.experiments.tasks import TASKS, make_start
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.prepare import plan
from vkc_pin.simulation.recording import ObjectState
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.estimated_joints import find_axis
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.frames import place_base
from vkc_pin.world.trajectory.robot_state import RobotState


@dataclass
class Observer:
    """A robot that sees the drawer where it is in a scene."""

    scene: Scene
    time: float
    positions: Floats
    held: frozenset[str] = frozenset()

    def read(self) -> RobotState:
        return RobotState(self.time, self.positions, np.zeros_like(self.positions))

    def object_states(self) -> dict[str, ObjectState]:
        placed = self.scene.objects["drawer"]
        return {"drawer": ObjectState({"slide": 0.0}, placed.placement)}


@pytest.fixture(scope="module")
def drawer_plan() -> Plan:
    found = plan(make_start("drawer", 1, 0), TASKS["drawer"].steps)
    assert found.success, found.summary()
    return found


def test_undisturbed_plan_is_executed_open_and_closed_loop(tmp_path: Path) -> None:
    arguments = "closed-loop --trials 1 --tasks drawer --rows nothing --save-motions"
    table, (trial,) = run_experiment(arguments, tmp_path)
    assert trial["success"] is True, trial["violations"]
    assert (trial["open"], trial["closed"]) == (True, True), trial
    assert trial["decisions"] == {"go on": trial["cycles"]}
    assert trial["closed_depth"] <= 1e-3
    assert "| nothing | drawer | 1 of 1 | 1 of 1 | 1 of 1 |" in table
    check_oracle(tmp_path, trial)


def check_oracle(folder: Path, trial: Mapping[str, Any]) -> None:
    """Check that the oracle finds nothing in a real motion, and something in a changed one."""
    path = folder / trial["motion"]
    assert path.name == "nothing_drawer_0000.npz"
    assert judge_motion(path, trial).found == []
    real = vkc.Plan.load(path)
    motion = real.trajectory
    positions = motion.positions.copy()
    positions[:, motion.names.index("drawer.slide")] *= 0.9  # misses its goal by 30 mm
    at = real.scene.objects["drawer"].placement.translation
    positions[motion.phases[1].first + 20, :2] = at[:2]  # the base overlaps the drawer
    changed = dataclasses.replace(motion, positions=positions)
    wrong = dataclasses.replace(real, trajectory=changed).save(folder / "wrong.npz")
    found = judge_motion(wrong, trial).found
    assert ("goal", "drawer.slide") in {(one.rule, one.subject) for one in found}
    overlaps = [one for one in found if one.rule == "overlap"]
    assert any("drawer" in one.subject for one in overlaps)
    # What touches an object before its place is known does not count.
    unknown = {**trial, "object": "drawer", "object_since": None}
    left = [one for one in judge_motion(wrong, unknown).found if one.rule == "overlap"]
    assert not any("drawer" in one.subject for one in left)
    unknown = {**trial, "robot_since": None}
    assert {one.rule for one in judge_motion(wrong, unknown).found} == {"goal"}


@pytest.mark.parametrize("row", ["displaced", "grasp"])
def test_object_is_seen_elsewhere_at_last(row: str, drawer_plan: Plan) -> None:
    found = _disturb(row, drawer_plan, np.random.default_rng(0))
    there = found.actual.objects["drawer"].placement
    assert there != drawer_plan.scene.objects["drawer"].placement
    motion = drawer_plan.trajectory
    end = motion.at(motion.times[-1])[:9]
    for clock, measured, seen in ((0.0, motion.at(0.0)[:9], False), (60.0, end, True)):
        robot: Any = Observer(found.actual, clock, measured)
        scene = found.observe(drawer_plan.scene, robot)
        assert (scene.objects["drawer"].placement == there) == seen


@pytest.mark.parametrize("row", ["obstacle", "person"])
def test_obstacle_is_where_it_is_seen(row: str, drawer_plan: Plan) -> None:
    scene = drawer_plan.scene
    document = dict(scene.document)
    person = {"name": "person", "type": "cylinder", "radius": 0.2, "length": 1.6}
    person["position"] = [0.0, 0.0, -5.0]
    document["obstacles"] = [*document.get("obstacles", []), person]
    with_person = type(scene).from_document(document, scene.folder)
    planned = dataclasses.replace(drawer_plan, scene=with_person)
    found = _disturb(row, planned, np.random.default_rng(1))
    assert found.obstacle is not None
    for clock in (0.0, 2.0, 9.0):
        robot: Any = Observer(scene, clock, scene.start)
        seen = found.observe(with_person, robot)
        (shape,) = [one for one in seen.obstacles if one.name == "person"]
        np.testing.assert_allclose(shape.placement.translation, found.obstacle(clock), atol=1e-12)


def test_robot_is_localised_near_a_landmark_once_it_has_moved(drawer_plan: Plan) -> None:
    """It is where the corrected frame has it: at its measured place minus the bias."""
    motion = drawer_plan.trajectory
    start, end = motion.at(0.0)[:9], motion.at(motion.times[-1])[:9]
    robot: Any = Observer(drawer_plan.scene, 0.0, start)
    robot.bias = np.array([0.02, -0.01, 0.017])
    landmark = drawer_plan.pose(None, float(motion.times[-1])).translation
    localise = _Localisation(robot, drawer_plan.scene, [landmark])
    far = motion.at(0.3)[:9]
    for positions, is_localised in ((start, False), (far, False), (end, True)):
        robot.positions = positions
        frame = localise()
        actual = place_base(frame, positions)[:3]
        expected = positions[:3] - robot.bias if is_localised else positions[:3]
        np.testing.assert_allclose(actual, expected, atol=1e-12)
    # Where it stands, it stays localised as it was.
    robot.bias = np.zeros(3)
    np.testing.assert_array_equal(localise(), frame)


def test_every_row_is_explained() -> None:
    assert all(about and not about.endswith(".") for about in ROWS.values())


def test_axis_is_elsewhere_and_the_handle_is_not(drawer_plan: Plan) -> None:
    scene = drawer_plan.scene
    actual = _disturb("axis", drawer_plan, np.random.default_rng(0)).actual
    before, after = scene.objects["drawer"], actual.objects["drawer"]
    assert after.link_placement("tray").isApprox(before.link_placement("tray"), 1e-12)
    _, described, _ = find_axis(before, "slide")
    _, real, _ = find_axis(after, "slide")
    assert 0.0 < np.arccos(described @ real) < np.radians(5.0)


def test_axis_of_a_cup_is_no_trial(tmp_path: Path) -> None:
    arguments = "closed-loop --trials 1 --tasks household_cup --rows axis"
    table, trials = run_experiment(arguments, tmp_path)
    assert trials == []
    assert "| axis | household_cup | does not apply: no joint |" in table
