"""Provides a plan that was not planned, for tests of trajectories."""

from __future__ import annotations

import pytest
from helpers.fake_plan import make_fake_plan

from vkc_pin import Plan


@pytest.fixture(scope="session")
def plan() -> Plan:
    return make_fake_plan()
