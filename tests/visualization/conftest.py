"""Provides a plan with a collision."""

from __future__ import annotations

import pytest
from helpers.fake_plan import make_fake_plan

from vkc_pin import Plan


@pytest.fixture(scope="package")
def plan() -> Plan:
    return make_fake_plan()
