"""Plans among measured points instead of the obstacles on which they were measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.clouds import replace_obstacles

import vkc_pin as vkc
from vkc_pin.validation.remaining import RemainingCheck

TASKS = {
    "drawer": vkc.Actuate("drawer", {"slide": 0.3}),
    "door": vkc.Actuate("door", {"hinge": 1.2}),
}


@pytest.mark.parametrize("name", TASKS)
def test_tasks_are_planned_among_points(name: str) -> None:
    scene = replace_obstacles(vkc.load_scene(name), 8000)
    plan = vkc.plan(scene, [TASKS[name]], seed=0)
    assert plan.success, str(plan.report)


def test_base_drives_around_a_wall_of_points(tmp_path: Path) -> None:
    """The straight line is blocked; the saved plan has the points, and is valid again."""
    scene = vkc.Scene.from_document(
        {
            "robot": "husky_ur5e",
            "start": {"base": [-1.5, 0.0, 0.0]},
            "arena": {"x": [-4.0, 4.0], "y": [-4.0, 4.0]},
        }
    )
    y, z = np.meshgrid(np.arange(-0.8, 0.8, 0.02), np.arange(0.06, 1.2, 0.02))
    wall = np.column_stack([np.full(y.size, 0.5), y.ravel(), z.ravel()])
    free = vkc.plan(scene, [vkc.GoTo(2.5, 0.0, 0.0)], seed=0)
    assert free.success
    assert np.abs(free.trajectory.positions[:, 1]).max() < 0.1
    blocked = scene.with_points(wall)
    report = vkc.validate(blocked, free.steps, free.trajectory)
    assert not report.ok
    assert any("points" in violation.subject for violation in report.violations)
    # Points of a later measurement block the rest of a motion that was free before.
    check = RemainingCheck(scene, free.steps, free.trajectory, free.options)
    assert not check.find_violations(scene)
    assert check.find_violations(blocked)
    around = vkc.plan(blocked, [vkc.GoTo(2.5, 0.0, 0.0)], seed=0)
    assert around.success, str(around.report)
    assert np.abs(around.trajectory.positions[:, 1]).max() > 0.8
    with pytest.raises(vkc.InputError, match="measured points cannot be simulated"):
        around.simulate()
    file = tmp_path / "plan.json"
    around.save(file)
    restored = vkc.Plan.load(file)
    assert restored.success
    assert restored.scene.point_counts == blocked.point_counts
