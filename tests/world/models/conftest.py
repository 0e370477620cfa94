"""Provides the robot of most tests of models."""

from __future__ import annotations

import pytest

from vkc_pin import Robot, load_robot


@pytest.fixture(scope="session")
def husky() -> Robot:
    return load_robot("husky_ur5e")
