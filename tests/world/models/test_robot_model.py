"""Tests the joint placements and visual geometry of robot models."""

from __future__ import annotations

import coal
import numpy as np
import pytest

from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.robot_file import load_robot


@pytest.fixture(scope="module")
def husky() -> Robot:
    return load_robot("husky_ur5e")


def test_joint_placements_are_rounded(husky: Robot) -> None:
    for joint in husky.model.jointPlacements:
        for entry in np.asarray(joint.homogeneous).ravel():
            assert entry in (0.0, 1.0, -1.0) or abs(entry) > 1e-3


def test_visual_geometry_is_simplified_and_coloured(husky: Robot) -> None:
    shapes = husky.visual.geometryObjects
    triangles = sum(
        shape.geometry.num_tris for shape in shapes if isinstance(shape.geometry, coal.BVHModelBase)
    )
    assert 10_000 < triangles < 100_000
    assert all(shape.meshPath == "" for shape in shapes)
    assert len({tuple(shape.meshColor.round(3)) for shape in shapes}) > 5
    assert husky.visual is husky.visual
