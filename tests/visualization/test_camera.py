from __future__ import annotations

import numpy as np
import pytest

from vkc_pin.visualization.camera import FIELD_OF_VIEW, LANDSCAPE, PORTRAIT, choose_viewpoint

MOTION = np.array(
    [[x, y, z] for x in np.linspace(-1, 3, 9) for y in (-0.5, 0.5) for z in (0.0, 1.5)]
)


def project(points: np.ndarray, aspect: float) -> tuple[np.ndarray, np.ndarray]:
    """Return horizontal and vertical positions in the picture: −1 and 1 at its edges."""
    target, position = choose_viewpoint(points, [], aspect)
    forward = target - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    local = points - position
    depth = local @ forward
    assert (depth > 0).all()
    half = np.tan(np.radians(FIELD_OF_VIEW) / 2)
    return local @ right / depth / (half * aspect), local @ np.cross(right, forward) / depth / half


@pytest.mark.parametrize("aspect", [LANDSCAPE, PORTRAIT])
@pytest.mark.parametrize("turn", [0.0, 0.7, 2.0, 4.0])
def test_camera_sees_the_whole_motion(aspect: float, turn: float) -> None:
    c, s = np.cos(turn), np.sin(turn)
    points = MOTION @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    across, up = project(points, aspect)
    assert np.abs(across).max() < 1.0
    assert np.abs(up).max() < 1.0
    # The camera is not too far away: the motion fills the longer side of the picture.
    longer = across if aspect > 1.0 else up
    assert np.ptp(longer) > 1.1


def test_motion_along_x_is_seen_from_its_side() -> None:
    target, position = choose_viewpoint(MOTION, [])
    assert position[1] < -2.0
    assert abs(position[0] - target[0]) < 1.5
    assert position[2] > target[2]


@pytest.mark.parametrize(("opacity", "behind"), [(1.0, False), (0.0, True)])
def test_camera_avoids_opaque_obstructions(opacity: float, behind: bool) -> None:
    cupboard = (np.array([-2.0, -1.6, 0.0]), np.array([4.0, -1.0, 4.0]), opacity)
    assert bool(choose_viewpoint(MOTION, [cupboard])[1][1] < -1.6) is behind
