"""Friction grasps carry objects within the friction cone and lose them beyond it."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest
from helpers.executions import drawer_plan, holding, still
from helpers.grippers import between_cheeks, write_gripper

import vkc_pin as vkc
from vkc_pin.planning.plan import Plan
from vkc_pin.simulation.execution import simulate


@cache
def cup_plan() -> Plan:
    """Return a plan that carries a cup to another table."""
    plan = vkc.plan(vkc.load_scene("household"), [vkc.Place("cup", (-0.6, -1.6, 0.751))])
    assert plan.success
    return plan


def test_drawer_is_pulled_by_friction() -> None:
    plan = drawer_plan()
    result = plan.simulate(grasp="friction")
    assert result.ok, result.summary()
    assert result.contacts == ()
    (grip,) = result.grips
    assert grip.slip < 0.005
    # The pulling force is about that of a weld; the robot waits while the fingers close.
    welded = plan.simulate().grips[0]
    assert 0.2 * welded.force < grip.force < 3.0 * welded.force
    assert result.planned.times[-1] == pytest.approx(
        plan.trajectory.times[-1] + result.physics.grip_time
    )
    assert any("slide towards each other" in note for note in result.notes)


@pytest.mark.parametrize("physics", [vkc.Physics(friction=1e-3), vkc.Physics(closing_force=0.2)])
def test_slipping_object_is_lost(physics: vkc.Physics) -> None:
    result = drawer_plan().simulate(grasp="friction", physics=physics)
    assert not result.ok
    assert result.grips[0].broken is not None
    assert result.grips[0].slip > 0.005
    assert any("drawer.slide" in line for line in result.problems())


def test_cup_is_carried_and_placed() -> None:
    result = cup_plan().simulate(grasp="friction")
    assert result.ok, result.summary()
    (grip,) = result.grips
    assert grip.force > 0.25 * 9.81 * 0.9  # its weight at least
    # MuJoCo's default contacts creep on curves; see `Builder.has_friction_grasps`.
    assert grip.slip < 0.005
    assert max(miss.amount for miss in result.misses if miss.unit == "m") < 0.01


def test_described_gripper_closes_its_own_fingers(tmp_path: Path) -> None:
    scene = between_cheeks(write_gripper(tmp_path), opening=0.03)
    plan = vkc.plan(scene, [vkc.Actuate("drawer", {"slide": 0.15})])
    assert plan.success, plan.summary()
    result = plan.simulate(grasp="friction")
    assert result.ok, result.summary()
    assert not any("slide towards" in note for note in result.notes)
    # Fingers close on the handle, 20 mm apart, and slightly further as contacts are compliant.
    world = result.rows[:, len(scene.start) : len(scene.start) + 2]
    assert world.min() == pytest.approx(0.01, abs=0.004)


def test_object_in_hand_at_start_stays_there() -> None:
    scene = holding()
    result = simulate(scene, [vkc.Grasp("stick")], still(scene, 1.5), grasp="friction")
    (grip,) = result.grips
    assert grip.broken is None, result.summary()
    assert grip.force == pytest.approx(9.81 * 0.4, rel=0.3)
    assert result.misses[0].amount < 0.01
    lost = simulate(
        scene,
        [vkc.Grasp("stick")],
        still(scene, 1.5),
        grasp="friction",
        physics=vkc.Physics(friction=1e-3),
    )
    assert lost.grips[0].broken is not None or lost.misses[0].amount > 0.01
