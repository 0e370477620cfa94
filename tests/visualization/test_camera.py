from __future__ import annotations

import numpy as np
import pytest

from vkc_pin.visualization.camera import FIELD_OF_VIEW, choose_viewpoint

MOTION = np.array(
    [[x, y, z] for x in np.linspace(-1, 3, 9) for y in (-0.5, 0.5) for z in (0.0, 1.5)]
)


def test_camera_sees_the_whole_motion() -> None:
    target, position = choose_viewpoint(MOTION, [])
    depth_axis = target - position
    distance = np.linalg.norm(depth_axis)
    forward = depth_axis / distance
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    local = MOTION - position
    depth = local @ forward
    half = np.tan(np.radians(FIELD_OF_VIEW) / 2)
    assert (depth > 0).all()
    assert np.abs(local @ up / depth).max() < half
    assert np.abs(local @ right / depth).max() < 1.5 * half
    assert np.abs(local @ right / depth).max() > 0.5 * half, "the camera is not too far away"


def test_motion_along_x_is_seen_from_its_side() -> None:
    target, position = choose_viewpoint(MOTION, [])
    assert position[1] < -2.0
    assert abs(position[0] - target[0]) < 1.5
    assert position[2] > target[2]


@pytest.mark.parametrize(("opacity", "behind"), [(1.0, False), (0.0, True)])
def test_camera_avoids_opaque_obstructions(opacity: float, behind: bool) -> None:
    cupboard = (np.array([-2.0, -1.6, 0.0]), np.array([4.0, -1.0, 4.0]), opacity)
    assert bool(choose_viewpoint(MOTION, [cupboard])[1][1] < -1.6) is behind
