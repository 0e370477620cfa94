"""What may touch what is what the planner keeps apart; contacts that the plan has are no fault."""

from __future__ import annotations

import pytest
from helpers.executions import door_plan, holding

import vkc_pin as vkc
from vkc_pin.options import Options
from vkc_pin.simulation.contacts import touching_pairs, unwanted
from vkc_pin.validation.distances import Solids
from vkc_pin.validation.pairs import PairTable
from vkc_pin.world.scene.clearance_exemptions import allowances
from vkc_pin.world.scene.contact_rules import grasped, touching
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.trajectory.world_model import World


@pytest.mark.parametrize("grip", [True, False])
def test_all_that_the_planner_keeps_apart_meets_in_physics(grip: bool) -> None:
    plan = door_plan()
    world = World(plan.scene)
    labels = world.collision_labels
    holds = [hold for phase in plan.trajectory.phases for hold in phase.holds][:1] if grip else []
    pairs = touching_pairs(world, holds)
    meets = {frozenset(pair) for pair in pairs.always.tolist()}
    for i, kind in enumerate(pairs.types.tolist()):
        meets |= {
            frozenset((i, j)) for j, other in enumerate(pairs.affinities.tolist()) if kind & other
        }
    table = PairTable(plan.scene, Solids(world), plan.trajectory, 0.01)
    silent = {
        frozenset((one.first, one.second))
        for one in allowances(plan.scene, Options().dist_safe)
        if one.margin < 0.0
    }
    wanted = {
        frozenset(pair)
        for pair in table.pairs.tolist()
        if frozenset(labels[k] for k in pair) not in silent
    }
    assert wanted <= meets
    assert pairs.overlapping == ()
    if grip:
        hand, link = touching(plan.scene, holds[0]), grasped(plan.scene, holds[0])
        never = {
            frozenset((i, j))
            for i in range(len(labels))
            for j in range(len(labels))
            if labels[i] in hand and labels[j] == link
        }
        assert never
        assert not never & {
            frozenset(pair) for pair in pairs.always.tolist()
        }  # but by the hold's own bit
        assert pairs.bits[holds[0]]


def test_wheels_do_not_meet_the_floor_and_free_objects_do() -> None:
    scene = holding()
    world = World(scene)
    labels = world.collision_labels
    below = [
        pair
        for pair in touching_pairs(world, scene.holds).always.tolist()
        if FLOOR in (labels[pair[0]], labels[pair[1]])
    ]
    on_it = {labels[k] for pair in below for k in pair} - {FLOOR}
    assert any(label.startswith("stick.") for label in on_it)
    robot = {
        labels[i] for i, shape in enumerate(world.bodies.geometryObjects) if shape.parentJoint == 1
    }
    assert not robot & on_it


def test_contacts_that_the_plan_does_not_have_are_told_from_those_it_has() -> None:
    plan = door_plan()
    seen = {
        ("door.lever", "gripper_left_finger"): [(1.0, 2e-3), (1.01, 4e-3)],
        ("floor", "nowhere"): [(3.0, 5e-3)],
    }
    found = unwanted(plan.scene, plan.trajectory, seen, 0.01)
    assert [(contact.first, contact.depth) for contact in found] == [
        ("door.lever", 4e-3),
        ("floor", 5e-3),
    ]
    assert found[0].duration == pytest.approx(0.02)
    assert unwanted(plan.scene, plan.trajectory, {}, 0.01) == ()


def test_what_stands_on_something_may_touch_it() -> None:
    scene = vkc.load_scene("household")
    motion = vkc.plan(
        scene, [vkc.GoTo(float(scene.start[0]) + 0.2, float(scene.start[1]))]
    ).trajectory
    assert unwanted(scene, motion, {("coffee_table", "cup.cup"): [(0.5, 2e-3)]}, 0.01) == ()
