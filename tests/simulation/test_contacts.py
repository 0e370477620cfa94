"""Tests that contact pairs are those for which the planner keeps a clearance."""

from __future__ import annotations

import pytest
from helpers.executions import make_grasping_scene, make_stationary_motion, plan_door

import vkc_pin as vkc
from vkc_pin.options import Options
from vkc_pin.simulation.contacts import find_contact_pairs, find_unplanned_contacts
from vkc_pin.validation.collisions import PairTable
from vkc_pin.validation.distances import CollisionShapes
from vkc_pin.world.scene.clearance_exemptions import find_clearance_exemptions
from vkc_pin.world.scene.contact_rules import find_grasped_link, find_touch_links
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.trajectory.world_model import World


def test_contact_pairs_include_all_pairs_of_the_planner() -> None:
    plan = plan_door()
    world = World(plan.scene)
    labels = world.collision_labels
    holds = [hold for phase in plan.trajectory.phases for hold in phase.holds][:1]
    pairs = find_contact_pairs(world, holds)
    colliding = {frozenset(pair) for pair in pairs.always.tolist()}
    for i, kind in enumerate(pairs.types.tolist()):
        colliding |= {
            frozenset((i, j)) for j, other in enumerate(pairs.affinities.tolist()) if kind & other
        }
    table = PairTable(plan.scene, CollisionShapes(world), plan.trajectory, 0.01)
    exempt = {
        frozenset((one.first, one.second))
        for one in find_clearance_exemptions(plan.scene, Options().dist_safe)
        if one.margin < 0.0
    }
    required = {
        frozenset(pair)
        for pair in table.pairs.tolist()
        if frozenset(labels[k] for k in pair) not in exempt
    }
    assert required <= colliding
    assert pairs.overlapping == ()
    hand, link = find_touch_links(plan.scene, holds[0]), find_grasped_link(plan.scene, holds[0])
    grasp_pairs = {
        frozenset((i, j))
        for i in range(len(labels))
        for j in range(len(labels))
        if labels[i] in hand and labels[j] == link
    }
    assert grasp_pairs
    always = {frozenset(pair) for pair in pairs.always.tolist()}
    assert not grasp_pairs & always  # enabled only by the bit of the hold
    assert pairs.bits[holds[0]]


def test_free_objects_but_not_wheels_collide_with_the_floor() -> None:
    scene = make_grasping_scene()
    world = World(scene)
    labels, shapes = world.collision_labels, world.bodies.geometryObjects
    pairs = find_contact_pairs(world, scene.holds).always.tolist()
    names = [{labels[i], labels[j]} for i, j in pairs]
    colliding = set[str]().union(*(pair for pair in names if FLOOR in pair))
    assert any(label.startswith("stick.") for label in colliding)
    assert not colliding & {labels[k] for k, one in enumerate(shapes) if one.parentJoint == 1}


def test_unplanned_contacts_are_found() -> None:
    plan = plan_door()
    samples = {
        ("door.lever", "gripper_left_finger"): [(1.0, 2e-3), (1.01, 4e-3)],
        ("floor", "nowhere"): [(3.0, 5e-3)],
    }
    found = find_unplanned_contacts(plan.scene, plan.trajectory, samples, 0.01)
    depths = {contact.first: contact.depth for contact in found}
    assert depths == {"door.lever": 4e-3, "floor": 5e-3}
    assert found[0].duration == pytest.approx(0.02)
    assert find_unplanned_contacts(plan.scene, plan.trajectory, {}, 0.01) == ()


def test_contact_of_supported_object_with_its_support_is_planned() -> None:
    scene = vkc.load_scene("household")
    samples = {("coffee_table", "cup.cup"): [(0.5, 2e-3)]}
    assert find_unplanned_contacts(scene, make_stationary_motion(scene), samples, 0.01) == ()
