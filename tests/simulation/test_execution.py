"""Tests that simulation reproduces valid plans and reports deviations."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.drawers import add_boxes, load_drawer_scene
from helpers.executions import (
    make_grasping_scene,
    make_stationary_motion,
    plan_door,
    plan_drawer,
    replace_mass,
    simulate_drawer,
)

import vkc_pin as vkc
from vkc_pin.simulation.execution import simulate


def test_drawer_is_pulled() -> None:
    result = simulate_drawer()
    assert result.ok, result.summary()
    (miss,) = result.misses
    assert (miss.subject, miss.unit) == ("drawer.slide", "m")
    assert miss.amount < 0.01
    missed = abs(result.trajectory.column("drawer.slide")[-1] - 0.3)
    assert missed == pytest.approx(miss.amount, abs=1e-9)
    assert np.degrees(result.tracking.arm[0]) < 1.0
    assert result.tracking.base[0] < 0.02
    (grip,) = result.grips
    assert (grip.what, grip.broken) == ("drawer.handle", None)
    # Lower bound: the drawer's mass times the plan's largest acceleration.
    plan = plan_drawer().trajectory
    accelerations = plan.accelerations()[:, plan.names.index("drawer.slide")]
    assert grip.force > 0.3 * 5.0 * np.abs(accelerations).max()
    assert result.contacts == ()


def test_latched_door_opens_when_its_lever_is_turned() -> None:
    result = plan_door().simulate()
    assert result.ok, result.summary()
    before = result.trajectory.times < result.grips[0].begin
    assert np.abs(result.trajectory.column("door.hinge")[before]).max() < 1e-3
    assert result.trajectory.column("door.hinge")[-1] == pytest.approx(1.2, abs=0.02)
    assert result.trajectory.column("door.knob").max() > 0.4
    assert set(result.tracking.shares) == set(result.scene.robot.coordinates.names[3:])
    assert max(result.tracking.shares.values()) < 1.0


def test_hand_loses_heavy_object() -> None:
    scene = make_grasping_scene()
    heavy, motion = replace_mass(scene, "stick", 60.0), make_stationary_motion(scene)
    result = simulate(scene, [vkc.Grasp("stick")], motion, actual=heavy)
    assert result.grips[0].broken is not None
    assert "stick.grip was pulled out of the hand" in result.summary()
    assert not result.ok


def test_contact_with_unplanned_obstacle_is_reported() -> None:
    plan = plan_drawer()
    x, y = plan.trajectory.at(10.0)[:2].tolist()
    result = plan.simulate(actual=add_boxes(plan.scene, crate=((0.3, 0.3, 0.4), (x, y, 0.2))))
    assert not result.ok
    hit = [contact for contact in result.contacts if "crate" in (contact.first, contact.second)]
    assert 0.0 < hit[0].begin < 11.0
    assert max(contact.depth for contact in hit) > 1e-4
    assert any("drawer.slide" in line for line in result.problems())  # the drawer stays closed
    assert "crate" in result.summary()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "changes", [{}, {"damping_ratio": 100.0}, {"damping_ratio": 0.0, "settle": 0.0}]
)
def test_diverged_simulation_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, float]
) -> None:
    monkeypatch.chdir(tmp_path)
    unstable = vkc.Physics(timestep=0.01, base_bandwidth=1e7, arm_bandwidth=1e7, **changes)
    result = plan_drawer().simulate(physics=unstable)
    assert result.diverged is not None
    assert result.diverged < 10.0
    assert not result.ok
    assert "the integration diverged" in result.summary()
    assert len(result.rows) == len(result.trajectory.times)
    assert np.isfinite(result.rows).all()
    assert list(tmp_path.iterdir()) == []  # MuJoCo's log file would appear here


def test_simulation_is_deterministic() -> None:
    np.testing.assert_array_equal(plan_drawer().simulate().rows, simulate_drawer().rows)


def test_result_round_trips_through_json(tmp_path: Path) -> None:
    result = simulate_drawer()
    data = json.loads(result.to_json(tmp_path / "result.json").read_text(encoding="utf-8"))
    assert data["ok"] is True
    assert data["misses"][0]["subject"] == "drawer.slide"
    assert vkc.Trajectory.from_dict(data["trajectory"]).names == result.trajectory.names
    assert data["physics"]["timestep"] == result.physics.timestep


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("grasp", "glue"),
        ("physics", 3),
        ("actual", "drawer"),
        ("actual", vkc.load_scene("door")),
    ],
)
def test_invalid_argument_is_named(field: str, value: object) -> None:
    with pytest.raises(vkc.InputError) as caught:
        plan_drawer().simulate(**{field: value})
    assert caught.value.field == field


@pytest.mark.parametrize("grasp", ["weld", "friction"])
def test_motion_with_too_many_time_steps_is_rejected(grasp: str) -> None:
    motion = plan_drawer().trajectory
    slow = dataclasses.replace(motion, times=1e5 * motion.times, curve=None)
    with pytest.raises(vkc.InputError, match="too many time steps") as caught:
        simulate(plan_drawer().scene, plan_drawer().steps, slow, grasp=grasp)
    assert caught.value.field == "trajectory"


def test_planning_continues_from_the_executed_end_state() -> None:
    """The drawer is displaced by 6 mm when the hand closes."""
    scene = load_drawer_scene()
    shift = pin.SE3(np.eye(3), np.array([0.0, 0.006, 0.0]))
    actual = scene.with_placement("drawer", shift * scene.objects["drawer"].placement)
    grasp = vkc.plan(scene, [vkc.Grasp("drawer")])
    after = simulate(scene, grasp.steps, grasp.trajectory, actual=actual).end_scene()
    assert np.linalg.norm(after.holds[0].deviation[:3]) == pytest.approx(0.006, abs=5e-4)
    rest = vkc.plan(after, [vkc.Actuate("drawer", {"slide": 0.2})])
    assert rest.success, rest.summary()
    result = rest.simulate()
    assert result.ok, result.summary()
    end = result.end_scene()
    assert end.objects["drawer"].state[0] == pytest.approx(0.2, abs=5e-3)
    assert end.holds[0].deviation == pytest.approx(after.holds[0].deviation, abs=1e-3)
