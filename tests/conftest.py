"""What several test files need and what takes long to make."""

from __future__ import annotations

import pytest

import vkc_pin as vkc


@pytest.fixture(scope="session")
def door_plan() -> vkc.Plan:
    """A motion that drives up to the door, turns its knob and pushes it open to 1.2 rad, as planned."""
    scene = vkc.load_scene("door").with_start(base=[-0.03, 0.09, -1.19])
    plan = vkc.plan(scene, [vkc.Actuate("door", {"hinge": 1.2})])
    assert plan.success, plan.report()
    return plan
