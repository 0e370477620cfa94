"""Plans with differential bases whose wheels have no speed limit, as those of imported robots."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import vkc_pin as vkc


@pytest.mark.parametrize(("task", "goal"), [("door", {"hinge": 1.2}), ("drawer", {"slide": 0.35})])
def test_one_rolling_row_a_step_is_as_good_as_three(task: str, goal: dict[str, float]) -> None:
    """Without a limit of the wheels the program has fewer rows, and is no harder to solve."""
    scene = vkc.load_scene(task)
    robot = vkc.load_robot("husky_ur5e", base="differential")
    start = scene.sample_start(np.random.default_rng(4)).start
    evaluations = []
    for one in (robot, dataclasses.replace(robot, wheels=None)):
        wheeled = dataclasses.replace(scene, robot=one, start=start)
        plan = vkc.plan(wheeled, [vkc.Actuate(task, goal)], seed=0)
        assert plan.success, plan.report
        evaluations.append(plan.statistics.evaluations)
    with_limits, without_limits = evaluations
    assert without_limits < 2.0 * with_limits
