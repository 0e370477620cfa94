"""Tests plans in which objects rest on moving links."""

from __future__ import annotations

import dataclasses

import numpy as np
import pinocchio as pin
import pytest
from helpers.judging import get_violation_names
from helpers.supports import TOP, make_plate_scene, make_tray_scene, slide_plate

import vkc_pin as vkc
from vkc_pin.options import Options
from vkc_pin.validation.validate import validate
from vkc_pin.world.trajectory.free_objects import FreeObjects
from vkc_pin.world.trajectory.world_model import World, compute_final_scene


def compute_placements(plan: vkc.Plan, name: str = "cup") -> list[pin.SE3]:
    world = World(plan.scene)
    return [world.get_placement(name, row) for row in world.compute_positions(plan.trajectory)]


def test_supported_object_moves_with_its_support() -> None:
    plan = vkc.plan(
        make_plate_scene(wall=0.03),
        [vkc.Actuate("plate", {"slide": 0.4}), vkc.Place("cup", [0.2, -1.0, 0.0])],
    )
    assert plan.success, plan.summary()
    slide = plan.trajectory.column("plate.slide")
    for value, placement in zip(
        slide[: plan.trajectory.phases[1].last], compute_placements(plan), strict=False
    ):
        np.testing.assert_allclose(
            placement.translation, [0.8 - value, 0.05, TOP], rtol=0.0, atol=1e-9
        )
    np.testing.assert_allclose(
        compute_placements(plan)[-1].translation, [0.2, -1.0, 0.0], rtol=0.0, atol=1e-3
    )
    supports = FreeObjects(plan.scene, plan.trajectory).supports
    assert [support for support in supports if support] == [{"cup": "plate.plate"}]


def test_tray_is_carried_level() -> None:
    plan = vkc.plan(make_tray_scene(), [vkc.Place("tray", [-0.5, -1.5, 0.7])])
    assert plan.success, plan.summary()
    assert (
        max(
            float(np.arccos(min(placement.rotation[2, 2], 1.0)))
            for placement in compute_placements(plan)
        )
        < 1e-3
    )
    offset = compute_placements(plan, "tray")[-1].actInv(compute_placements(plan)[-1]).translation
    np.testing.assert_allclose(offset, [0.02, 0.05, 0.02], rtol=0.0, atol=1e-9)


def test_support_grasped_at_the_start_carries_its_object() -> None:
    first = vkc.plan(make_tray_scene(), [vkc.Grasp("tray"), vkc.GoTo(-1.0, 0.3)])
    assert first.success, first.summary()
    after = compute_final_scene(first.scene, first.trajectory, first.trajectory.phases[-1].holds)
    second = vkc.plan(after, [vkc.Place("tray", [-0.5, -1.5, 0.7])])
    assert second.success, second.summary()
    offset = (
        compute_placements(second, "tray")[-1].actInv(compute_placements(second)[-1]).translation
    )
    np.testing.assert_allclose(offset, [0.02, 0.05, 0.02], rtol=0.0, atol=1e-5)


def test_tilt_and_collision_of_supported_objects() -> None:
    flap, options = make_plate_scene("flap"), Options()
    tipped = validate(flap, [vkc.Actuate("plate", {"tip": 0.4})], slide_plate(flap, 0.4), options)
    assert ("tips", "cup") in get_violation_names(tipped)
    assert ("tips", "cup") not in get_violation_names(
        validate(flap, [vkc.Actuate("plate", {"tip": 0.05})], slide_plate(flap, 0.05), options)
    )
    blocked = make_plate_scene()
    post = {
        "name": "post",
        "type": "box",
        "size": [0.02, 0.02, 0.05],
        "position": [0.55, 0.05, TOP + 0.06],
    }
    blocked = vkc.Scene.from_document({**blocked.document, "obstacles": [post]}, blocked.folder)
    hit = validate(
        blocked, [vkc.Actuate("plate", {"slide": 0.4})], slide_plate(blocked, 0.4), options
    )
    assert ("penetration", "cup.cup – post") in get_violation_names(hit)


def test_too_short_rest_for_the_gripper_is_a_violation() -> None:
    plan = vkc.plan(make_plate_scene(), [vkc.Actuate("plate", {"slide": 0.2})])
    assert plan.success, plan.summary()
    begin = plan.trajectory.phases[1].first
    times = plan.trajectory.times.copy()
    times[begin + 1 :] -= 0.4  # less time for the gripper
    curve = plan.trajectory.curve
    assert curve is not None
    knots = np.where(curve.times > plan.trajectory.times[begin], curve.times - 0.4, curve.times)
    hurried = dataclasses.replace(
        plan.trajectory, times=times, curve=dataclasses.replace(curve, times=knots)
    )
    hasty = validate(plan.scene, plan.steps, hurried, plan.options)
    assert get_violation_names(hasty) == {("dwell", "plate.handle")}
    (found,) = hasty.violations
    assert found.amount == pytest.approx(0.4, abs=1e-6)
    assert found.waypoint == begin
