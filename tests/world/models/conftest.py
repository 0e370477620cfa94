"""Provides the robot of most tests of models."""

from __future__ import annotations

import pytest

from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.robot_file import load_robot


@pytest.fixture(scope="session")
def husky() -> Robot:
    return load_robot("husky_ur5e")
