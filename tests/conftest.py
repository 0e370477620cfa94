"""What several test files need and what takes long to make."""

from __future__ import annotations

import os

import pytest
from hypothesis import settings

import vkc_pin as vkc

# The same examples every time, so that what passed goes on passing; HYPOTHESIS_PROFILE=random looks for new ones.
settings.register_profile("repeatable", derandomize=True)
settings.register_profile("random", derandomize=False)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))

# Nothing is compiled in the background and nothing is written to the user's home; tests of that name folders of their own.
os.environ["VKC_PIN_CACHE"] = "off"


@pytest.fixture(scope="session")
def door_plan() -> vkc.Plan:
    """A motion that drives up to the door, turns its knob and pushes it open to 1.2 rad, as planned."""
    scene = vkc.load_scene("door").with_start(base=[-0.03, 0.09, -1.19])
    plan = vkc.plan(scene, [vkc.Actuate("door", {"hinge": 1.2})])
    assert plan.success, plan.report()
    return plan
