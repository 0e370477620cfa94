"""Tests plans in which objects rest on moving links."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from helpers.carrying import describe_box
from helpers.drawers import replace_scene_fields
from helpers.judging import get_violation_names
from helpers.supports import TOP, make_plate_scene, make_tray_scene, slide_plate

import vkc_pin as vkc
from vkc_pin.options import Options
from vkc_pin.validation.validate import validate
from vkc_pin.world.trajectory.free_objects import FreeObjects
from vkc_pin.world.trajectory.world_model import World


def compute_placements(plan: vkc.Plan, name: str = "cup") -> list[pin.SE3]:
    world = World(plan.scene)
    return [world.get_placement(name, row) for row in world.compute_positions(plan.trajectory)]


def test_supported_object_moves_with_its_support() -> None:
    steps = [vkc.Actuate("plate", {"slide": 0.4}), vkc.Place("cup", [0.2, -1.0, 0.0])]
    plan = vkc.plan(make_plate_scene(wall=0.03), steps)
    assert plan.success, plan.summary()
    slide = plan.trajectory.column("plate.slide")[: plan.trajectory.phases[1].last]
    found = np.array([one.translation for one in compute_placements(plan)])
    expected = [0.8, 0.05, TOP] - slide[:, None] * [1, 0, 0]
    np.testing.assert_allclose(found[: len(slide)], expected, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(found[-1], [0.2, -1.0, 0.0], rtol=0.0, atol=1e-3)
    supports = FreeObjects(plan.scene, plan.trajectory).supports
    assert [support for support in supports if support] == [{"cup": "plate.plate"}]


PLACE = vkc.Place("tray", [-0.5, -1.5, 0.7])


def compute_offset(plan: vkc.Plan) -> np.ndarray:
    """Return the final position of the cup on the tray."""
    tray, cup = (compute_placements(plan, name)[-1] for name in ("tray", "cup"))
    return np.asarray(tray.actInv(cup).translation)


def test_tray_is_carried_level() -> None:
    plan = vkc.plan(make_tray_scene(), [PLACE])
    assert plan.success, plan.summary()
    assert min(one.rotation[2, 2] for one in compute_placements(plan)) > np.cos(1e-3)
    np.testing.assert_allclose(compute_offset(plan), [0.02, 0.05, 0.02], rtol=0.0, atol=1e-9)


def test_support_grasped_at_the_start_carries_its_object() -> None:
    first = vkc.plan(make_tray_scene(), [vkc.Grasp("tray"), vkc.GoTo(-1.0, 0.3)])
    assert first.success, first.summary()
    second = vkc.plan(first.end_scene(), [PLACE])
    assert second.success, second.summary()
    np.testing.assert_allclose(compute_offset(second), [0.02, 0.05, 0.02], rtol=0.0, atol=1e-5)


def validate_sliding(scene: vkc.Scene, joint: str, value: float) -> set[tuple[str, str]]:
    """Return the violations of a motion that moves the plate."""
    step, motion = vkc.Actuate("plate", {joint: value}), slide_plate(scene, value)
    return get_violation_names(validate(scene, [step], motion, Options()))


def test_tilt_and_collision_of_supported_objects() -> None:
    for tip, tips in ((0.4, True), (0.05, False)):
        found = validate_sliding(make_plate_scene("flap"), "tip", tip)
        assert (("tips", "cup") in found) == tips
    post = describe_box("post", [0.02, 0.02, 0.05], [0.55, 0.05, TOP + 0.06])
    blocked = replace_scene_fields(make_plate_scene(), obstacles=[post])
    assert ("penetration", "cup.cup – post") in validate_sliding(blocked, "slide", 0.4)
