"""Provides a hall and a drive through it."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.drives import drive_through, make_hall, move_start

from vkc_pin import Scene, Trajectory


@pytest.fixture(scope="package")
def hall() -> Scene:
    return make_hall()


@pytest.fixture(scope="package")
def drive(hall: Scene) -> Trajectory:
    """Return a drive two metres ahead with a quarter turn."""
    return drive_through(hall, hall.start, move_start(hall.start, x=2.0, yaw=np.pi / 2))
