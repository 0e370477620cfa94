"""Tests the monitor of the closed loop."""

from __future__ import annotations

import numpy as np
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


def test_object_that_is_elsewhere_is_touched_before_its_grasp(door_plan: vkc.Plan) -> None:
    monitor = Monitor(door_plan)
    scene = door_plan.scene
    motion = door_plan.trajectory
    closing = float(motion.times[next(p.first for p in motion.phases if p.holds)])
    there = scene.objects["door"].placement

    def displace(x: float) -> vkc.Scene:
        shift = pin.SE3(np.eye(3), np.array([x, 0.0, 0.0]))
        return scene.with_placement("door", shift * there)

    finding, touched = monitor.check_world(0.0, displace(-0.03))
    assert finding == "door is elsewhere"
    assert 0.0 < touched < closing
    assert monitor.check_world(0.0, displace(8.0)) == ("door is elsewhere", np.inf)
    # The hand is always near to an object that it holds.
    end = float(motion.times[-1])
    assert monitor.check_world(end - 0.1, displace(-0.03)) == ("door is elsewhere", np.inf)


def test_all_objects_that_are_elsewhere_count() -> None:
    """The first one is far from the path now, another one on it."""
    plan = vkc.plan(vkc.load_scene("tray"), [vkc.GoTo(-1.0, 0.8)])
    assert plan.success, plan.summary()
    first, second = list(plan.scene.objects)[:2]
    monitor = Monitor(plan)
    away = plan.scene.objects[first].placement.copy()
    away.translation[0] += 20.0
    scene = plan.scene.with_placement(first, away)
    assert monitor.check_world(0.0, scene) == (f"{first} is elsewhere", np.inf)
    middle = plan.trajectory.at(float(plan.trajectory.times[-1]) / 2.0)
    on_path = pin.SE3(np.eye(3), np.array([*middle[:2], 0.3]))
    finding, touched = monitor.check_world(0.0, scene.with_placement(second, on_path))
    assert finding == f"{first} is elsewhere"
    assert touched < plan.trajectory.times[-1]
