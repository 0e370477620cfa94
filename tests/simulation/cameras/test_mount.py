from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.simulation.cameras import BASE, HAND, Camera
from vkc_pin.world.models.robot_file import load_robot

points = st.tuples(*[st.floats(-3.0, 3.0)] * 3)


@given(points, points, points)
def test_target_is_centred_and_up_points_up(
    position: tuple[float, ...], target: tuple[float, ...], up: tuple[float, ...]
) -> None:
    ahead = np.subtract(target, position)
    assume(
        np.linalg.norm(np.cross(ahead, up))
        > 1e-2 * max(1.0, np.linalg.norm(ahead) * np.linalg.norm(up))
    )
    place = Camera("eye", BASE, position, target, up=up).placement  # type: ignore[arg-type]
    in_camera = place.inverse().act(np.array(target))
    np.testing.assert_allclose(in_camera, [0.0, 0.0, -np.linalg.norm(ahead)], atol=1e-9)
    above = place.rotation.T @ np.array(up)
    assert above[1] > 0.0
    assert above[0] == pytest.approx(0.0, abs=1e-9)
    assert np.linalg.det(place.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("target", [(0.0, 0.0, 1.0), (0.0, 0.0, 0.3)])
def test_camera_with_undefined_orientation_is_rejected(target: tuple[float, float, float]) -> None:
    with pytest.raises(vkc.InputError, match="orientation of camera 'eye' is undefined"):
        Camera("eye", BASE, (0.0, 0.0, 1.0), target)


def test_frames_resolve_to_robot_frames() -> None:
    robot = load_robot("husky_ur5e")
    pose = {"position": (0.0, 0.0, 1.0), "target": (1.0, 0.0, 0.0)}
    assert Camera("eye", HAND, **pose).find_frame(robot) == robot.tool_frame
    assert Camera("eye", BASE, **pose).find_frame(robot) == robot.model.names[1]
    assert Camera("eye", "wrist_3_link", **pose).find_frame(robot) == "wrist_3_link"
    with pytest.raises(vkc.UnknownNameError, match="did you mean 'wrist_3_link'"):
        Camera("eye", "wrist_3_lnk", **pose).find_frame(robot)
