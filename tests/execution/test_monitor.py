"""Tests the monitor of the closed loop."""

from __future__ import annotations

import pinocchio as pin
import pytest

import vkc_pin as vkc
from vkc_pin.execution.monitor import Monitor


@pytest.mark.parametrize(
    ("name", "distance", "angle", "notices"),
    [
        ("door", 0.0005, 0.0, False),
        ("door", 0.002, 0.0, True),
        ("door", 0.0, 0.005, True),
        # Free objects are touched, and move a little: no reason to plan again.
        ("cup", 0.002, 0.0, False),
        ("cup", 0.0, 0.02, False),
        ("cup", 0.005, 0.0, True),
    ],
)
def test_displaced_objects_are_noticed(
    name: str, distance: float, angle: float, notices: bool
) -> None:
    scene = {"door": "door", "cup": "tray"}[name]
    plan = vkc.plan(vkc.load_scene(scene), [vkc.GoTo(-1.0, 0.8)])
    assert plan.success, plan.summary()
    placement = plan.scene.objects[name].placement.copy()
    placement.translation[0] += distance
    placement.rotation = pin.utils.rotate("z", angle) @ placement.rotation
    finding, _ = Monitor(plan).check_world(0.0, plan.scene.with_placement(name, placement))
    assert bool(finding) is notices, finding
